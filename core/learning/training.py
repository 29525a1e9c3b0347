"""Training of a network by its recipe.

Lightning does the loop: it keeps and resumes checkpoints, mixes precisions, averages weights, writes for TensorBoard and
shares the work among GPUs and nodes, all of which is code that we need not write, nor maintain.
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
from ..progress import Progress, Stages
from .data import Samples, Source, prepared
from .judging.sets import events_by_recipe, set_fingerprint
from .model_file import Contents, TrainedNetwork, read_model, write_model
from .networks import NETWORKS
from .recipe import TrainingRecipe
from .setup import Sample, Setup

_ON_THE_WAY = 0.3  # weight of estimates before the last
_ROUNDS, _LONGEST = 20, 200  # rounds of a training, if they are not longer than so many steps
_LAST = "last.ckpt"
_VALIDATED = 32  # samples at the end of each round


def nrmse(estimate: Tensor, truth: Tensor) -> Tensor:
    """Root mean square error as a share of the truth's root mean square, the mean of a batch; volumes (B, ...)."""
    errors, squares = (estimate - truth).square().flatten(1).mean(1), truth.square().flatten(1).mean(1)
    return (errors / squares.clamp(min=1e-12) + 1e-12).sqrt().mean()  # its gradient is finite at 0


def loss_of(estimates: list[Tensor], truth: Tensor) -> Tensor:
    """The NRMSE of the last estimate (B, 1, ...), and a share of those before it."""
    *before, last = (nrmse(each[:, 0].float(), truth) for each in estimates)
    return last + _ON_THE_WAY * sum(before)  # type: ignore[no-any-return]


class Trained(pl.LightningModule):
    """A network in training: loss, steps, rate, and the learning curve, which checkpoints keep."""

    def __init__(self, network: torch.nn.Module, setup: Callable[[], Setup], recipe: TrainingRecipe):
        super().__init__()
        self.network = network
        self.told = setup  # a function, which the average of the weights does not copy with the module
        self.recipe, self.steps = recipe, recipe["training.steps"]
        self.curve: list[dict[str, float]] = []
        self._losses: list[Tensor] = []  # of the steps of this round
        self.spent, self._begun = 0.0, time.monotonic()

    def training_step(self, batch: Sample) -> Tensor:
        """The loss of a batch. Random numbers depend on the step alone, so that a stopped training goes on with the same."""
        random = np.random.SeedSequence((self.recipe["training.seed"], self.global_step))
        torch.manual_seed(int(random.generate_state(1)[0]))
        estimates = self.network(self.told(), batch)
        self._losses.append(nrmse(estimates[-1].detach()[:, 0].float(), batch.truth))
        loss = loss_of(estimates, batch.truth)
        self.log("loss", loss.detach(), sync_dist=True)
        return loss

    def validation_step(self, batch: Sample) -> None:
        """The NRMSE of the mean weights."""
        found = nrmse(self.network(self.told(), batch)[-1][:, 0].float(), batch.truth)
        self.log("validation", found, on_epoch=True, sync_dist=True, batch_size=len(batch.truth))

    def on_train_epoch_end(self) -> None:
        """A row of the learning curve."""
        train, self._losses = torch.stack(self._losses).mean(), []
        now = time.monotonic()
        self.spent, self._begun = self.spent + now - self._begun, now
        validation = self.trainer.callback_metrics.get("validation")
        self.curve.append({
            "step": self.global_step,
            "seconds": round(self.spent, 2),
            "events": self.global_step * self.recipe["training.batch"],
            "train": float(self.trainer.strategy.reduce(train, reduce_op="mean")),
            "validation": math.nan if validation is None else float(validation),
        })  # fmt: skip

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the curve."""
        checkpoint["curve"], checkpoint["spent"] = self.curve, self.spent

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Go on with the curve."""
        self.curve, self.spent, self._begun = checkpoint["curve"], checkpoint["spent"], time.monotonic()

    def configure_optimizers(self) -> Any:
        """AdamW; the rate rises at first, then falls to 0 as a cosine."""
        optimizer = torch.optim.AdamW(self.parameters(), lr=self.recipe["training.rate"], weight_decay=1e-3)
        first = min(50, 1 + self.steps // 10)
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimizer, lambda step: min(1, (step + 1) / first) * (0.5 + 0.5 * math.cos(math.pi * step / self.steps))
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


class _Rounds(pl.LightningDataModule):
    """Batches of each round, in an order that seed and round decide; each process takes its part of a batch."""

    def __init__(self, train: Samples, validation: Samples, recipe: TrainingRecipe, length: int) -> None:
        super().__init__()
        self.train, self.validation, self.recipe, self.length = train, validation, recipe, length

    def train_dataloader(self) -> DataLoader[Sample]:
        """The batches of the round that begins; the last may be shorter."""
        batch, done = self.recipe["training.batch"], self._trainer.current_epoch
        random = np.random.default_rng((self.recipe["training.seed"], done))
        count = min(self.length, self.recipe["training.steps"] - done * self.length) * batch
        passes = math.ceil(count / len(self.train))
        order = np.concatenate([random.permutation(len(self.train)) for _ in range(passes)])[:count]
        return DataLoader(self.train, batch_sampler=self._own(order.reshape(-1, batch).T).T.tolist())

    def val_dataloader(self) -> DataLoader[Sample]:
        """Some samples of the validation's, always the same."""
        n = len(self.validation)
        chosen = np.unique(np.linspace(0, n - 1, min(n, _VALIDATED)).astype(int))
        processes = self._trainer.world_size
        whole = np.resize(chosen, math.ceil(len(chosen) / processes) * processes)
        return DataLoader(self.validation, batch_sampler=self._own(whole[:, None]).tolist())

    def _own(self, rows: NDArray[np.integer[Any]]) -> NDArray[np.integer[Any]]:
        """This process's rows."""
        return rows[self._trainer.global_rank :: self._trainer.world_size]

    @property
    def _trainer(self) -> pl.Trainer:
        assert self.trainer is not None
        return self.trainer


class _Watch(Callback):
    """Says how far the training is; what `progress` raises ends it. After each round writes the learning curve."""

    def __init__(self, folder: Path, steps: int, progress: Progress | None) -> None:
        self.folder, self.steps, self.progress = folder, steps, progress

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        """One step is done."""
        if self.progress is not None and trainer.is_global_zero:
            self.progress(trainer.global_step, self.steps)

    def on_save_checkpoint(self, trainer: pl.Trainer, pl_module: Any, checkpoint: dict[str, Any]) -> None:
        """One round is done."""
        if trainer.is_global_zero:
            write_bytes(self.folder / "curve.json", json.dumps(pl_module.curve, indent=1).encode())


def train(
    recipe: TrainingRecipe, path: AnyPath, workers: int = 1, stages: Stages = lambda stage: None
) -> TrainedNetwork:
    """Train a network, and write its model file.

    Parameters
    ----------
    recipe
        Of `read_recipe`.
    path
        The file, ending in .pt. Beside it are the samples (``samples-…``) and the training's own folder
        (``NAME-training``): its last checkpoint, from which a later call goes on, the learning curve, and what
        TensorBoard shows.
    workers
        Processes that prepare samples.
    stages
        Begins each stage: preparing, training. What its callbacks raise stops the work, which goes on at the next call.

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
    network = _begun(recipe, source)  # refused, if it is, before samples are prepared
    splits = recipe["data.train"], recipe["data.validation"]
    samples, validation = prepared(source, folder.parent, splits, workers, stages("preparing"))
    with _quiet():
        precision = _kept_precision(recipe, source, folder)
        module = Trained(network, lambda: source.setup, recipe)
        length = min(_LONGEST, math.ceil(recipe["training.steps"] / _ROUNDS))
        trainer, last = _trainer(recipe, folder, precision, length, stages("training")), folder / _LAST
        _fit(trainer, module, _Rounds(samples, validation, recipe, length), last)
    if trainer.is_global_zero:
        write_model(_contents(recipe, source, samples, last), path)
    trainer.strategy.barrier()
    return read_model(path)


def _begun(recipe: TrainingRecipe, source: Source) -> torch.nn.Module:
    """The network with its first weights, those of another model where the recipe names one."""
    pl.seed_everything(recipe["training.seed"], verbose=False)
    cls: Any = NETWORKS[recipe["network.kind"]].load()
    network: torch.nn.Module = cls(**recipe.network, **cls.fixed(source.setup))
    if recipe["network.weights_from"] is not None:
        with naming("network.weights_from"):
            known, own = read_model(recipe.path("network.weights_from")).contents.weights, network.state_dict()
            taken = {name: values for name, values in known.items() if name in own and own[name].shape == values.shape}
            if not taken:
                raise InputError("that model has no weights of the same names and shapes")
        network.load_state_dict(own | taken)
    return network


def _kept_precision(recipe: TrainingRecipe, source: Source, folder: Path) -> str:
    """The numbers that a training computes in, kept in its folder; `InputError` where that is of another recipe."""
    path, known = folder / "plan.json", f"{recipe.fingerprint} {source.fingerprint}"
    if not (folder / _LAST).exists():
        write_bytes(path, json.dumps({"recipe": known, "precision": _precision(recipe)}).encode())
    with reading(path, "the plan of a training"):
        plan = json.loads(read_text(path))
        if plan["recipe"] != known:
            raise InputError("of a training by another recipe: remove its folder, or choose another -o")
        return str(plan["precision"])


def _device(recipe: TrainingRecipe) -> torch.device:
    """What one process computes on."""
    chosen = recipe["training.accelerator"]
    return torch.device("cuda" if chosen == "gpu" or (chosen == "auto" and torch.cuda.is_available()) else "cpu")


def _precision(recipe: TrainingRecipe) -> str:
    """The numbers that a network computes in."""
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
    """Lightning's trainer of a recipe, whose rounds have so many steps."""
    steps = recipe["training.steps"]
    decay = 1 - 1 / min(max(steps / 50, 1), 1000)  # the mean is over the last steps, at a small rate
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
            callbacks=[EMAWeightAveraging(decay=decay), checkpoints, _Watch(folder, steps, progress)],
        )
    except (ImportError, ValueError, MisconfigurationException) as error:
        keys = "accelerator, devices, nodes, strategy or precision"
        raise InputError(f"training: Lightning refuses {keys}: {first_line(error)}") from None


def _fit(trainer: pl.Trainer, module: Trained, rounds: "_Rounds", last: Path) -> None:
    """Train from the beginning, or from the last checkpoint; Ctrl-C is a `KeyboardInterrupt`, as everywhere."""
    if last.exists():
        with reading(last, "a checkpoint; remove it to begin anew"):
            torch.load(last, map_location="cpu", weights_only=True)
    is_main = threading.current_thread() is threading.main_thread()
    usual = signal.getsignal(signal.SIGINT)
    try:
        trainer.fit(module, datamodule=rounds, ckpt_path=str(last) if last.exists() else None)
    except SystemExit:  # what Lightning makes of it
        raise KeyboardInterrupt from None
    finally:
        if is_main:
            signal.signal(signal.SIGINT, usual)


def _contents(recipe: TrainingRecipe, source: Source, samples: Samples, last: Path) -> Contents:
    """What the model file holds: the mean weights of the last checkpoint, and what it was trained for and on."""
    kept, prefix = torch.load(last, map_location="cpu", weights_only=True), "network."
    weights = {name.removeprefix(prefix): values for name, values in kept["state_dict"].items()}
    setup, grid = source.setup, recipe.grid
    counts = [float(samples.record(i)["counts"].sum(dtype=float)) for i in range(len(samples))]
    seen = source.events.split(recipe["data.train"]) + source.events.split(recipe["data.validation"])
    network: Any = NETWORKS[recipe["network.kind"]].load()
    return Contents(
        weights,
        recipe=recipe.text,
        scanner=setup.scanner,
        shape=grid.shape,
        affine=grid.affine.tolist(),
        physics=setup.physics,
        fixed=network.fixed(setup),
        counts=(min(counts), max(counts)),
        trained_on={
            "events": events_by_recipe(seen), "set": set_fingerprint(seen), "samples": source.fingerprint,
            "model": source.model, "levels": list(source.levels), "count": len(samples),
        },
        curve=kept["curve"],
    )  # fmt: skip


@contextmanager
def _quiet() -> Iterator[None]:
    """Lightning says what it does, which is no news here; errors are raised."""
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
