"""Training of a network by its recipe.

Lightning runs the loop: it keeps and resumes checkpoints, mixes precisions, averages weights, writes for TensorBoard and
distributes the work over GPUs and nodes, so that this code need not.
"""

import json
import logging
import math
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from glob import escape
from pathlib import Path
from typing import Any

import lightning as pl
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, EMAWeightAveraging, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader

from ..errors import InputError, first_line, naming, refusing, warn
from ..files import AnyPath, ensure_folder, locked, read_bytes, remove_leftovers, require_ending, write_bytes
from ..progress import Progress, Stages, tell
from .data import Samples, Source, prepare_samples
from .judging.sets import events_by_recipe, set_fingerprint, truths_of
from .model_file import ModelContents, TrainedNetwork, read_model, write_model
from .networks import NETWORKS
from .recipe import OPTIMIZERS, TrainingRecipe
from .seals import Damaged, read_sealed, write_sealed
from .setup import Sample, ScannerSetup

_INTERMEDIATE_WEIGHT = 0.3  # weight in the loss of each estimate before the last
_ROUNDS, _MAX_ROUND = 20, 200  # number of rounds of a training; steps of a round at most, with more rounds if necessary
_LAST, _EARLIER = "last.ckpt", "last-but-one.ckpt"  # checkpoints of the last round and of the round before
_VALIDATED = 32  # number of validation samples at the end of each round


def nrmse(estimate: Tensor, truth: Tensor) -> Tensor:
    """Return the root mean square error divided by the truth's root mean square, averaged over volumes (B, ...)."""
    errors, squares = (estimate - truth).square().flatten(1).mean(1), truth.square().flatten(1).mean(1)
    return (errors / squares.clamp(min=1e-12) + 1e-12).sqrt().mean()  # its gradient is finite at 0


def training_loss(estimates: list[Tensor], truth: Tensor) -> Tensor:
    """Return the NRMSE of the last estimate (B, 1, ...), plus a share of that of each estimate before it."""
    *intermediate, last = (nrmse(estimate[:, 0].float(), truth) for estimate in estimates)
    return last + _INTERMEDIATE_WEIGHT * sum(intermediate)  # type: ignore[no-any-return]


def _require_finite(values: Iterable[Tensor], name: str, step: int, recipe: TrainingRecipe) -> None:
    """Raise `InputError`, which says what to try, if some of the values, such as "the loss is", are not finite."""
    if not all(bool(value.isfinite().all()) for value in values):
        remedy = f"try a smaller training.rate than {recipe['training.rate']:g}, and another -o"
        raise InputError(f"training: step {step}: {name} not finite; {remedy}")


class NetworkTraining(pl.LightningModule):
    """Lightning module of a network: loss, optimiser, learning rate, and what checkpoints keep: learning curve and plan.

    The `plan` is what a resumed training shares with its beginning. The training ends with an `InputError` as soon as loss,
    weights or validation are not finite.
    """

    def __init__(
        self, network: torch.nn.Module, setup: Callable[[], ScannerSetup], recipe: TrainingRecipe, plan: dict[str, Any]
    ):
        super().__init__()
        self.network, self.plan = network, plan
        self.get_setup = setup  # a function, so that weight averaging does not copy the setup with the module
        self.recipe, self.steps = recipe, recipe["training.steps"]
        self.curve: list[dict[str, float]] = []
        self._losses: list[Tensor] = []  # losses of the steps of this round
        self.seconds, self._resumed_at = 0.0, time.monotonic()

    def training_step(self, batch: Sample) -> Tensor:
        """Return the loss of a batch.

        Random numbers depend on the step alone, so that a resumed training continues with the same ones.
        """
        random = np.random.SeedSequence((self.recipe["training.seed"], self.global_step))
        torch.manual_seed(int(random.generate_state(1)[0]))
        estimates = self.network(self.get_setup(), batch)
        self._losses.append(nrmse(estimates[-1].detach()[:, 0].float(), batch.truth))
        loss = training_loss(estimates, batch.truth)
        _require_finite([loss], "the loss is", self.global_step + 1, self.recipe)
        self.log("loss", loss.detach(), sync_dist=True)
        return loss

    def on_train_batch_end(self, *_: Any) -> None:
        """Check the weights after each step."""
        _require_finite(self.network.state_dict().values(), "the weights are", self.global_step, self.recipe)

    def validation_step(self, batch: Sample) -> None:
        """Log the NRMSE of the averaged weights on a batch."""
        error = nrmse(self.network(self.get_setup(), batch)[-1][:, 0].float(), batch.truth)
        self.log("validation", error, on_epoch=True, sync_dist=True, batch_size=len(batch.truth))

    def on_train_epoch_end(self) -> None:
        """Append a row to the learning curve."""
        train, self._losses = torch.stack(self._losses).mean(), []
        now = time.monotonic()
        self.seconds, self._resumed_at = self.seconds + now - self._resumed_at, now
        validation = self.trainer.callback_metrics["validation"]
        _require_finite([validation], "the validation is", self.global_step, self.recipe)
        self.curve.append({
            "step": self.global_step,
            "seconds": round(self.seconds, 2),
            "events": self.global_step * self.recipe["training.batch"],
            "train": float(self.trainer.strategy.reduce(train, reduce_op="mean")),
            "validation": float(validation),
        })  # fmt: skip

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the learning curve and the plan in the checkpoint."""
        checkpoint |= {"curve": self.curve, "spent": self.seconds, "plan": self.plan}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the learning curve from the checkpoint."""
        self.curve, self.seconds, self._resumed_at = checkpoint["curve"], checkpoint["spent"], time.monotonic()

    def configure_optimizers(self) -> Any:
        """Return the recipe's optimiser with a learning rate that rises at first, then falls to 0 as a cosine."""
        algorithm, rate = OPTIMIZERS[self.recipe.choice("training.optimizer", OPTIMIZERS)], self.recipe["training.rate"]
        optimizer = getattr(torch.optim, algorithm.name)(self.parameters(), lr=rate, **algorithm.options)
        n_warmup = min(50, 1 + self.steps // 10)
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: min(1, (step + 1) / n_warmup) * (0.5 + 0.5 * math.cos(math.pi * step / self.steps))
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


class _RoundBatches(pl.LightningDataModule):
    """Batches of each round, in an order that follows from seed and round; each process gets its share of a batch."""

    def __init__(self, train: Samples, validation: Samples, recipe: TrainingRecipe, length: int) -> None:
        super().__init__()
        self.train, self.validation, self.recipe, self.length = train, validation, recipe, length

    def setup(self, stage: str) -> None:
        """Give all processes the samples of the first one: the set may have grown before another one began."""
        for samples in (self.train, self.validation):
            samples.draws = self._trainer.strategy.broadcast(samples.draws)

    def train_dataloader(self) -> DataLoader[Sample]:
        """Return the batches of the next round; the last round may be shorter."""
        batch, round_index = self.recipe["training.batch"], self._trainer.current_epoch
        random = np.random.default_rng((self.recipe["training.seed"], round_index))
        n_samples = min(self.length, self.recipe["training.steps"] - round_index * self.length) * batch
        n_passes = math.ceil(n_samples / len(self.train))
        order = np.concatenate([random.permutation(len(self.train)) for _ in range(n_passes)])[:n_samples]
        return DataLoader(self.train, batch_sampler=self._process_share(order.reshape(-1, batch).T).T.tolist())

    def val_dataloader(self) -> DataLoader[Sample]:
        """Return some of the validation samples, always the same."""
        chosen = _validated(self.validation)
        n_processes = self._trainer.world_size
        padded = np.resize(chosen, math.ceil(len(chosen) / n_processes) * n_processes)
        return DataLoader(self.validation, batch_sampler=self._process_share(padded[:, None]).tolist())

    def _process_share(self, rows: NDArray[np.integer[Any]]) -> NDArray[np.integer[Any]]:
        """Return the rows that this process computes."""
        return rows[self._trainer.global_rank :: self._trainer.world_size]

    @property
    def _trainer(self) -> pl.Trainer:
        """Trainer that this data module belongs to."""
        assert self.trainer is not None
        return self.trainer


def _validated(samples: Samples) -> NDArray[np.int64]:
    """Return the indices of the validation samples that are used, always the same."""
    return np.unique(np.linspace(0, len(samples) - 1, min(len(samples), _VALIDATED)).astype(int))


class _SealedCheckpoints(TorchCheckpointIO):
    """Lightning's reading and writing of checkpoints, here sealed files; the one of the round before is kept beside."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: AnyPath, storage_options: Any = None) -> None:
        """Write a checkpoint; a damaged one does not replace that of the round before."""
        if Path(path).exists():
            with suppress(Damaged):
                read_sealed(Path(path), "checkpoint")
                write_bytes(Path(path).with_name(_EARLIER), read_bytes(path))
        write_sealed(path, checkpoint)

    def load_checkpoint(self, path: AnyPath, *_: Any, **__: Any) -> dict[str, Any]:
        """Return the content of a checkpoint."""
        return read_sealed(Path(path), "checkpoint")[0]  # type: ignore[no-any-return]


def last_checkpoint(folder: Path) -> tuple[Path | None, dict[str, Any]]:
    """Return the path and the content of the last whole checkpoint in a training's folder; None if there is none.

    Warns if the last one is damaged or missing.
    """
    problems: list[str] = []
    for path in filter(Path.exists, (folder / _LAST, folder / _EARLIER)):
        try:
            content = read_sealed(path, "checkpoint")[0]
        except Damaged as error:
            problems.append(str(error))
            continue
        if path.name == _EARLIER:
            warn(f"{(problems or [f'{folder / _LAST}: missing'])[0]}; the training goes on from the round before")
        return path, content
    if problems:
        warn(f"{problems[0]}; the training begins again")
    return None, {}


class _ProgressReport(Callback):
    """Callback that reports steps to `progress`, which ends the training by an exception, and writes the learning curve."""

    def __init__(self, folder: Path, steps: int, progress: Progress | None) -> None:
        self.folder, self.steps, self.progress = folder, steps, progress

    def on_train_batch_end(self, trainer: pl.Trainer, _module: Any, outputs: Any, *_: Any) -> None:
        """Report a step."""
        if trainer.is_global_zero:
            tell(self.progress, trainer.global_step, self.steps, lambda: f"loss {outputs['loss']:.3g}")

    def on_save_checkpoint(self, trainer: pl.Trainer, pl_module: Any, checkpoint: dict[str, Any]) -> None:
        """Write the learning curve after a round."""
        if trainer.is_global_zero:
            write_bytes(self.folder / "curve.json", json.dumps(pl_module.curve, indent=1).encode())


def train(
    recipe: TrainingRecipe, path: AnyPath, workers: int = 1, stages: Stages = lambda stage: None
) -> TrainedNetwork:
    """Train a network and write its model file.

    Parameters
    ----------
    recipe
        As read by `read_recipe`.
    path
        The model file, ending in .pt. Beside it are the samples (``samples-…``) and the training's own folder
        (``NAME-training``): its last checkpoint, from which a later call resumes, the learning curve, and the logs for
        TensorBoard.
    workers
        Number of processes that prepare samples.
    stages
        Called with the name of each stage, preparing and training; returns the stage's progress callback. An exception
        raised there stops the work, which the next call resumes.

    Returns
    -------
    TrainedNetwork

    Raises
    ------
    InputError
        The events cannot be used, or the folder holds a training by another recipe.
    """
    path = Path(path)
    require_ending(path, (".pt",))
    folder = ensure_folder(path.absolute().with_name(f"{path.stem}-training"))
    refusal = f"{folder}: another process trains here; wait for its end, or choose another -o"
    with locked(folder / ".lock", refusal) if _is_first(recipe) else nullcontext():
        remove_leftovers(folder)
        remove_leftovers(folder.parent, f".*-{escape(path.name)}")
        _train(recipe, path, folder, workers, stages)
    return read_model(path)


def _is_first(recipe: TrainingRecipe) -> bool:
    """Return whether this process is the first of its training, as far as the environment tells before Lightning begins."""
    return recipe.processes == 1 or (rank_zero_only.rank == 0 and os.environ.get("NODE_RANK", "0") == "0")


def _train(recipe: TrainingRecipe, path: Path, folder: Path, workers: int, stages: Stages) -> None:
    """Train a network in its folder and write its model file."""
    last, checkpoint = last_checkpoint(folder)
    source = Source(recipe)
    plan = _plan(recipe, source, last, checkpoint)
    torch.set_num_threads(recipe["training.threads"] or torch.get_num_threads())
    network = _initial_network(recipe, source)  # raises before samples are prepared
    splits = recipe["data.train"], recipe["data.validation"]
    samples, validation = prepare_samples(source, folder.parent, splits, workers, stages("preparing"))
    with _quiet(), refusing(folder, "cannot be written"):
        module = NetworkTraining(network, lambda: source.setup, recipe, plan)
        length = min(_MAX_ROUND, math.ceil(recipe["training.steps"] / _ROUNDS))
        trainer = _trainer(recipe, folder, plan["precision"], length, stages("training"))
        _fit(trainer, module, _RoundBatches(samples, validation, recipe, length), last)
        if trainer.is_global_zero:
            contents = _model_contents(recipe, source, samples, folder / _LAST)
            # Mixed precision, and a share of the samples for each process, gave a somewhat different error at the last step.
            error = _error(TrainedNetwork(path, "", contents).network, source.setup, validation)
            _require_finite([error], "the result is", recipe["training.steps"], recipe)
            curve = [*contents.curve[:-1], {**contents.curve[-1], "validation": float(error)}]
            write_model(replace(contents, curve=curve), path)
        trainer.strategy.barrier()


def _error(network: torch.nn.Module, setup: ScannerSetup, samples: Samples) -> Tensor:
    """Return the mean NRMSE of a network over the validation samples that are used."""
    with torch.no_grad():
        batches = (Sample(*(values[None] for values in samples[i])) for i in _validated(samples).tolist())
        return torch.stack([nrmse(network(setup, batch)[-1][:, 0].float(), batch.truth) for batch in batches]).mean()


def _initial_network(recipe: TrainingRecipe, source: Source) -> torch.nn.Module:
    """Return the network with its initial weights, including those of another model file if the recipe names one."""
    pl.seed_everything(recipe["training.seed"], verbose=False)
    cls: Any = NETWORKS[recipe["network.kind"]].load()
    network: torch.nn.Module = cls(**recipe.network, **cls.fixed(source.setup))
    if recipe["network.weights_from"] is not None:
        with naming("network.weights_from"):
            loaded, initial = read_model(recipe.path("network.weights_from")).contents.weights, network.state_dict()
            matching = {name: w for name, w in loaded.items() if name in initial and initial[name].shape == w.shape}
            if not matching:
                raise InputError("that model has no weights of the same names and shapes")
        network.load_state_dict(initial | matching)
    return network


def _plan(recipe: TrainingRecipe, source: Source, last: Path | None, checkpoint: dict[str, Any]) -> dict[str, Any]:
    """Return the plan of a training, which its checkpoints keep: hashes of its recipe, its events, and its precision.

    A resumed training uses the events that it began with. Raises `InputError` if the last checkpoint is of a training by
    another recipe.
    """
    fingerprint = [recipe.fingerprint, source.fingerprint]
    if last is None:
        return {"recipe": fingerprint, "events": source.used.numbers, "precision": _precision(recipe)}
    plan: dict[str, Any] = checkpoint["plan"]
    if plan["recipe"] != fingerprint:
        raise InputError(f"{last}: of a training by another recipe: remove its folder, or choose another -o")
    source.restrict(plan["events"])
    return plan


def _device(recipe: TrainingRecipe) -> torch.device:
    """Return the device on which each process computes."""
    name = recipe["training.accelerator"]
    return torch.device("cuda" if name == "gpu" or (name == "auto" and torch.cuda.is_available()) else "cpu")


def _precision(recipe: TrainingRecipe) -> str:
    """Return Lightning's name of the precision in which the network computes."""
    if recipe["training.precision"] is not None:
        return str(recipe["training.precision"])
    if _device(recipe).type == "cuda":
        is_fast = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        is_fast = getattr(torch.cpu, "_is_amx_tile_supported", bool)()
    return "bf16-mixed" if is_fast else "32"


def _trainer(
    recipe: TrainingRecipe, folder: Path, precision: Any, length: int, progress: Progress | None
) -> pl.Trainer:
    """Return Lightning's trainer for a recipe, with rounds of `length` steps."""
    steps = recipe["training.steps"]
    decay = 1 - 1 / min(max(steps / 50, 1), 1000)  # averages the last steps, whose learning rate is small
    checkpoints = ModelCheckpoint(folder, "last", save_on_train_epoch_end=True, enable_version_counter=False)
    try:
        return pl.Trainer(
            accelerator={"cuda": "gpu"}.get(_device(recipe).type, "cpu"),
            devices=recipe["training.devices"],
            num_nodes=recipe["training.nodes"],
            strategy=recipe["training.strategy"],
            precision=precision,
            max_epochs=math.ceil(steps / length),
            gradient_clip_val=1.0,
            num_sanity_val_steps=0,
            reload_dataloaders_every_n_epochs=1,
            use_distributed_sampler=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            log_every_n_steps=10,
            logger=TensorBoardLogger(folder, name="", version="tensorboard"),
            plugins=[_SealedCheckpoints()],
            callbacks=[EMAWeightAveraging(decay=decay), checkpoints, _ProgressReport(folder, steps, progress)],
        )
    except (ImportError, ValueError, MisconfigurationException) as error:
        keys = "accelerator, devices, nodes, strategy or precision"
        raise InputError(f"training: Lightning refuses {keys}: {first_line(error)}") from None


def _fit(trainer: pl.Trainer, module: NetworkTraining, rounds: _RoundBatches, last: Path | None) -> None:
    """Train from the start or from the last checkpoint; Ctrl-C raises `KeyboardInterrupt`, as everywhere."""
    is_main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT)
    try:
        trainer.fit(module, datamodule=rounds, ckpt_path=None if last is None else str(last))
    except SystemExit:  # Lightning turns Ctrl-C into this
        raise KeyboardInterrupt from None
    finally:
        if is_main:
            signal.signal(signal.SIGINT, handler)


def _model_contents(recipe: TrainingRecipe, source: Source, samples: Samples, last: Path) -> ModelContents:
    """Return the contents of the model file: averaged weights of the last checkpoint, and the data of the training."""
    checkpoint, prefix = read_sealed(last, "checkpoint")[0], "network."
    weights = {name.removeprefix(prefix): values for name, values in checkpoint["state_dict"].items()}
    setup, grid, events = source.setup, recipe.grid, source.used
    counts = [float(samples[i].counts.sum(dtype=torch.float64)) for i in range(len(samples))]
    network: Any = NETWORKS[recipe["network.kind"]].load()
    return ModelContents(
        weights,
        recipe=recipe.text,
        scanner=setup.scanner,
        shape=grid.shape,
        affine=grid.affine.tolist(),
        physics=setup.physics,
        fixed=network.fixed(setup),
        counts=(min(counts), max(counts)),
        trained_on={
            "events": events_by_recipe(events), "truths": sorted({*truths_of(events)}), "set": set_fingerprint(events),
            "samples": source.fingerprint, "model": source.model, "levels": list(source.levels), "count": len(samples),
        },
        curve=checkpoint["curve"],
    )  # fmt: skip


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Lightning's reports and warnings, and tracebacks of TensorBoard's thread; errors are still raised."""
    hook = threading.excepthook
    logs = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [log.level for log in logs]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"(lightning|torch)\b")
        for log in logs:
            log.setLevel(logging.ERROR)
        threading.excepthook = lambda thread: None if issubclass(thread.exc_type, OSError) else hook(thread)
        try:
            yield
        finally:
            for thread in threading.enumerate():
                if type(thread).__module__.startswith("tensorboard."):
                    thread.join(1)  # it may still be failing
            threading.excepthook = hook
            for log, level in zip(logs, levels, strict=True):
                log.setLevel(level)
