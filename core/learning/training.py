"""Training of a network by its recipe.

Lightning runs the loop: it keeps and resumes checkpoints, mixes precisions, averages weights, writes for TensorBoard and
distributes the work over GPUs and nodes, so that this code need not.
"""

import json
import logging
import math
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning as pl
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback, EMAWeightAveraging, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader

from ..errors import InputError, first_line, naming, reading
from ..files import AnyPath, ensure_folder, read_text, require_ending, write_bytes
from ..progress import Progress, Stages, tell
from .data import Samples, Source, prepare_samples
from .judging.sets import events_by_recipe, set_fingerprint, truths_of
from .model_file import ModelContents, TrainedNetwork, read_model, write_model
from .networks import NETWORKS
from .recipe import OPTIMIZERS, TrainingRecipe
from .setup import Sample, ScannerSetup

_INTERMEDIATE_WEIGHT = 0.3  # weight in the loss of each estimate before the last
_ROUNDS, _MAX_ROUND = 20, 200  # number of rounds of a training; steps of a round at most, with more rounds if necessary
_LAST = "last.ckpt"
_VALIDATED = 32  # number of validation samples at the end of each round


def nrmse(estimate: Tensor, truth: Tensor) -> Tensor:
    """Return the root mean square error divided by the truth's root mean square, averaged over volumes (B, ...)."""
    errors, squares = (estimate - truth).square().flatten(1).mean(1), truth.square().flatten(1).mean(1)
    return (errors / squares.clamp(min=1e-12) + 1e-12).sqrt().mean()  # its gradient is finite at 0


def training_loss(estimates: list[Tensor], truth: Tensor) -> Tensor:
    """Return the NRMSE of the last estimate (B, 1, ...), plus a share of that of each estimate before it."""
    *intermediate, last = (nrmse(estimate[:, 0].float(), truth) for estimate in estimates)
    return last + _INTERMEDIATE_WEIGHT * sum(intermediate)  # type: ignore[no-any-return]


class NetworkTraining(pl.LightningModule):
    """Lightning module of a network: loss, optimiser, learning rate, and the learning curve, which checkpoints keep."""

    def __init__(self, network: torch.nn.Module, setup: Callable[[], ScannerSetup], recipe: TrainingRecipe):
        super().__init__()
        self.network = network
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
        self.log("loss", loss.detach(), sync_dist=True)
        return loss

    def validation_step(self, batch: Sample) -> None:
        """Log the NRMSE of the averaged weights on a batch."""
        error = nrmse(self.network(self.get_setup(), batch)[-1][:, 0].float(), batch.truth)
        self.log("validation", error, on_epoch=True, sync_dist=True, batch_size=len(batch.truth))

    def on_train_epoch_end(self) -> None:
        """Append a row to the learning curve."""
        train, self._losses = torch.stack(self._losses).mean(), []
        now = time.monotonic()
        self.seconds, self._resumed_at = self.seconds + now - self._resumed_at, now
        validation = self.trainer.callback_metrics.get("validation")
        self.curve.append({
            "step": self.global_step,
            "seconds": round(self.seconds, 2),
            "events": self.global_step * self.recipe["training.batch"],
            "train": float(self.trainer.strategy.reduce(train, reduce_op="mean")),
            "validation": math.nan if validation is None else float(validation),
        })  # fmt: skip

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store the learning curve in the checkpoint."""
        checkpoint["curve"], checkpoint["spent"] = self.curve, self.seconds

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
        n = len(self.validation)
        chosen = np.unique(np.linspace(0, n - 1, min(n, _VALIDATED)).astype(int))
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
    source = Source(recipe)
    torch.set_num_threads(recipe["training.threads"] or torch.get_num_threads())
    network = _initial_network(recipe, source)  # raises before samples are prepared
    splits = recipe["data.train"], recipe["data.validation"]
    samples, validation = prepare_samples(source, folder.parent, splits, workers, stages("preparing"))
    with _quiet():
        precision = _recorded_precision(recipe, source, folder)
        module = NetworkTraining(network, lambda: source.setup, recipe)
        length = min(_MAX_ROUND, math.ceil(recipe["training.steps"] / _ROUNDS))
        trainer, last = _trainer(recipe, folder, precision, length, stages("training")), folder / _LAST
        _fit(trainer, module, _RoundBatches(samples, validation, recipe, length), last)
    if trainer.is_global_zero:
        write_model(_model_contents(recipe, source, samples, last), path)
    trainer.strategy.barrier()
    return read_model(path)


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


def _recorded_precision(recipe: TrainingRecipe, source: Source, folder: Path) -> str:
    """Return the precision of a training, which its folder records when it starts.

    Raises `InputError` if the folder holds a training by another recipe.
    """
    path, fingerprint = folder / "plan.json", f"{recipe.fingerprint} {source.fingerprint}"
    if not (folder / _LAST).exists():
        write_bytes(path, json.dumps({"recipe": fingerprint, "precision": _precision(recipe)}).encode())
    with reading(path, "the plan of a training"):
        plan = json.loads(read_text(path))
        if plan["recipe"] != fingerprint:
            raise InputError("of a training by another recipe: remove its folder, or choose another -o")
        return str(plan["precision"])


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
            callbacks=[EMAWeightAveraging(decay=decay), checkpoints, _ProgressReport(folder, steps, progress)],
        )
    except (ImportError, ValueError, MisconfigurationException) as error:
        keys = "accelerator, devices, nodes, strategy or precision"
        raise InputError(f"training: Lightning refuses {keys}: {first_line(error)}") from None


def _fit(trainer: pl.Trainer, module: NetworkTraining, rounds: "_RoundBatches", last: Path) -> None:
    """Train from the start or from the last checkpoint; Ctrl-C raises `KeyboardInterrupt`, as everywhere."""
    if last.exists():
        with reading(last, "a checkpoint; remove it to begin anew"):
            torch.load(last, map_location="cpu", weights_only=True)
    is_main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT)
    try:
        trainer.fit(module, datamodule=rounds, ckpt_path=str(last) if last.exists() else None)
    except SystemExit:  # Lightning turns Ctrl-C into this
        raise KeyboardInterrupt from None
    finally:
        if is_main:
            signal.signal(signal.SIGINT, handler)


def _model_contents(recipe: TrainingRecipe, source: Source, samples: Samples, last: Path) -> ModelContents:
    """Return the contents of the model file: averaged weights of the last checkpoint, and the data of the training."""
    checkpoint, prefix = torch.load(last, map_location="cpu", weights_only=True), "network."
    weights = {name.removeprefix(prefix): values for name, values in checkpoint["state_dict"].items()}
    setup, grid = source.setup, recipe.grid
    counts = [float(samples.record(i)["counts"].sum(dtype=float)) for i in range(len(samples))]
    events = source.events.split(recipe["data.train"]) + source.events.split(recipe["data.validation"])
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
    """Silence Lightning's reports and warnings; errors are still raised."""
    logs = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [log.level for log in logs]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"(lightning|torch)\b")
        for log in logs:
            log.setLevel(logging.ERROR)
        try:
            yield
        finally:
            for log, level in zip(logs, levels, strict=True):
                log.setLevel(level)
