"""Model files (.pt), sealed: a network's weights with its recipe, scanner and training data."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from ..errors import InputError, naming, reading, warn
from ..files import AnyPath, require_ending
from ..geometry.grid import Grid, same_grid
from ..progress import Progress, tell
from ..projector import Projector
from ..reconstruction.counts import CountData
from ..reconstruction.methods import Method
from ..reconstruction.result import Reconstruction
from ..recording import recorded_warnings
from ..runs.reconstructing import reconstruct_run
from ..runs.run import ProjectionRun, versions
from ..validation import one_of
from ..volumes.volume import Volume
from .judging.methods import JudgedMethod
from .networks import NETWORKS
from .recipe import TrainingRecipe, parse_recipe
from .seals import read_sealed, write_sealed
from .setup import ScannerSetup

_FORMAT, _VERSION = "mphDRR network", 1
ALLOWED = ("scanner", "grid", "physics")
"""Conditions of training that a user may allow to differ."""
_NO_PHYSICS = ("time", "background")
"""Entries of a model's record that may differ, since a network gets counts and background of each scan."""
_DEFAULTS = {
    "start": 0.0, "efficiency": 1.0, "energy_fwhm": None, "lines": "together", "plate_thickness": None,
    "wall_thickness": None,
}  # fmt: skip
"""Values of entries that records of earlier versions lack."""
_MAX_SETUPS = 4
_SETUPS: dict[Any, ScannerSetup] = {}
"""Cache of setups for all networks, the last used one last, of at most `_MAX_SETUPS`."""
_COUNTS_FACTOR = 2.0  # factor beyond the counts of the training data from which on a warning is given


@dataclass(frozen=True, eq=False)
class ModelContents:
    """Contents of a model file: the weights, and texts and numbers about them."""

    weights: Mapping[str, torch.Tensor]
    recipe: str  # recipe of the training, TOML
    scanner: str  # `ScannerSetup.scanner`
    shape: Sequence[int]  # shape of the grid
    affine: Sequence[Sequence[float]]  # affine matrix of the grid, world mm from index
    physics: str  # `ScannerSetup.physics`
    fixed: Mapping[str, Any]  # the network's keyword-only arguments, by `Network.fixed`
    counts: Sequence[float]  # fewest and most counts of a scan of the training data
    trained_on: Mapping[str, Any]
    """Training data: events by their recipes' hashes, and their truths; name of the set, hash, model, levels, samples."""
    curve: Sequence[Mapping[str, float]]  # learning curve
    judgement: Mapping[str, Any] | None = None  # the judge's record, if the network was judged
    versions: Mapping[str, str] = field(default_factory=versions)

    @cached_property
    def grid(self) -> Grid:
        """Voxels of the network's volumes."""
        n_x, n_y, n_z = self.shape
        return Grid((n_x, n_y, n_z), np.array(self.affine))

    def differing(self, setup: ScannerSetup) -> list[str]:
        """Return the names in `ALLOWED` of the conditions in which a setup differs from the training."""
        is_same = {
            "scanner": setup.scanner == self.scanner,
            "grid": same_grid(setup.A.grid, self.grid),
            "physics": _physics(setup.physics) == _physics(self.physics),
        }
        return [name for name in ALLOWED if not is_same[name]]


def _physics(text: str) -> dict[str, Any]:
    """Return a model's record, as JSON text, without the entries that may differ, and with defaults for missing ones."""
    record = _DEFAULTS | json.loads(text)
    times = record["time"] if isinstance(record.get("time"), list) else []  # a single time is a mere scale
    return {name: value for name, value in record.items() if name not in _NO_PHYSICS} | {"times": times}


def write_model(contents: ModelContents, path: AnyPath) -> None:
    """Write a model file with its seal; raise `InputError` for another ending than .pt, or if it cannot be written."""
    require_ending(path, (".pt",))
    about = {name: value for name, value in vars(contents).items() if name in ModelContents.__annotations__}
    weights = {name: values.detach().cpu().contiguous() for name, values in about.pop("weights").items()}
    write_sealed(path, {"format": _FORMAT, "version": _VERSION, "weights": weights, "about": json.dumps(about)})


def _read_contents(path: Path) -> tuple[ModelContents, str]:
    """Read a file's contents and digest; raise `InputError` if it is damaged or holds anything but data."""
    saved, digest = read_sealed(path, "model file")
    with naming(path):
        if not isinstance(saved, dict) or saved.get("format") != _FORMAT:
            raise InputError("no model file of mphDRR")
        if saved["version"] != _VERSION:
            raise InputError(f"format {saved['version']}; this mphDRR reads {_VERSION}, a newer one may read it")
        with reading(path, "a model file"):
            return ModelContents(saved["weights"], **json.loads(saved["about"])), digest


@dataclass(frozen=True, eq=False)
class TrainedNetwork:
    """A network from a model file: ``model(run)`` reconstructs a run.

    >>> model = mph.learning.read_model("model.pt")
    >>> volume = model(mph.read_run("run.h5"))
    """

    path: Path
    sha256: str
    contents: ModelContents
    _last_setup: list[ScannerSetup] = field(
        default_factory=list, init=False, repr=False
    )  # of the last scan, at most one

    def __call__(self, run: ProjectionRun, allow: Sequence[str] = ()) -> Volume:
        """Reconstruct a run by the same scanner and physics, on the network's grid.

        Parameters
        ----------
        run
            Simulated or measured counts.
        allow
            Names among "scanner", "grid" and "physics" of conditions that may differ from the training's.

        Warns
        -----
        InputWarning
            An allowed condition differs, or the run has far fewer or more counts than the training data.
        """
        settings = {"reconstruction.method": str(self.path), "reconstruction.allow": tuple(allow) or None}
        return reconstruct_run(run, run.recipe.updated(settings), method=self.method).volume

    @cached_property
    def recipe(self) -> TrainingRecipe:
        """Recipe of the training."""
        return parse_recipe(self.contents.recipe, f"{self.path}: its recipe")

    @cached_property
    def network(self) -> torch.nn.Module:
        """The network itself, with its weights, in evaluation mode."""
        network_class = NETWORKS[self.recipe["network.kind"]].load()
        with reading(self.path, "weights of this version's network"):
            network: torch.nn.Module = network_class(**self.recipe.network, **self.contents.fixed)
            network.load_state_dict(dict(self.contents.weights))
        return network.eval()

    @property
    def label(self) -> str:
        """Name in messages and records, with the kind of network and its file."""
        return f"Network {self.path.name} ({NETWORKS[self.recipe['network.kind']].label})"

    @property
    def method(self) -> Method:
        """The network as a method of `reconstruct_run`."""
        text = NETWORKS[self.recipe["network.kind"]].text
        return Method(self.label, text, self.reconstruct, objective="", grid=self.contents.grid)

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of all that its volumes depend on; unlike the file's, it does not change with a judge's table."""
        digest = hashlib.sha256(repr((self.contents.recipe, self.contents.scanner, self.contents.physics)).encode())
        for name, values in sorted(self.contents.weights.items()):
            digest.update(name.encode() + values.numpy().tobytes())
        return digest.hexdigest()

    def judged(self, name: str) -> JudgedMethod:
        """Return the network as a method for the judge, under a name in its table.

        It is also judged on scanners and physics that it was not trained for.
        """

        def volume(run: ProjectionRun) -> Volume:
            """Reconstruct a run without warnings, since the judge knows what differs."""
            with recorded_warnings():
                return self(run, ("scanner", "physics"))

        trained_on, truths = self.contents.trained_on["events"], self.contents.trained_on.get("truths", ())
        return JudgedMethod(name, volume, self.fingerprint, trained_on, lambda: self._last_setup[-1].saved, truths)

    def setup(self, A: Projector) -> ScannerSetup:
        """Return the setup of a projector, cached for later scans by the same scanner and for other networks."""
        settings = tuple(self.recipe[key] for key in ("osem.subsets", "osem.after", "network.permuted"))
        setup = ScannerSetup(A, *settings)
        if getattr(A.model, "mu", None) is not None:  # its record does not identify mu, so it cannot be cached
            return setup
        key = setup.scanner, setup.physics, A.grid.shape, A.grid.affine.tobytes(), settings
        _SETUPS[key] = _SETUPS.pop(key, setup)
        if len(_SETUPS) > _MAX_SETUPS:
            del _SETUPS[next(iter(_SETUPS))]
        return _SETUPS[key]

    def reconstruct(
        self,
        A: Projector,
        images: ArrayLike,
        allow: Sequence[str] = (),
        background: ArrayLike = 0.0,
        progress: Progress | None = None,
    ) -> Reconstruction:
        """Reconstruct a volume from counts.

        Parameters
        ----------
        A : Projector
            A projector of emission, on the network's grid.
        images
            Counts (M, n_v, n_u).
        allow
            Names in `ALLOWED` of conditions that may differ from the training's.
        background
            Expected counts besides those of the volume and of the projector's model.
        progress
            Called before and after.
        """
        data, setup = CountData.checked(self.label, A, images, background), self.setup(A)
        self._last_setup[:] = [setup]
        doubts = [*self._allowed_differences(setup, allow), *self._count_differences(float(data.counts.sum()))]
        for text in doubts:
            warn(text, 2)
        tell(progress, 0, 1)
        sample = setup.sample(data.counts, np.array(data.background), np.zeros(A.shape_in, np.float32))
        with torch.no_grad():
            volume = self.network(setup, sample)[-1][0, 0] * sample.scale[0]
        tell(progress, 1, 1)
        record = {
            "method": self.label, "network": self.recipe["network.kind"], "file": str(self.path), "sha256": self.sha256,
            "allow": list(allow), "flatters": doubts, "stopped": "iterations",
        }  # fmt: skip
        note = ". ".join([f"Reconstructed by a {self.label[0].lower()}{self.label[1:]}, sha256 {self.sha256}", *doubts])
        return Reconstruction(Volume(volume.float().numpy(), A.grid, note=note), np.zeros(0), record)

    def _allowed_differences(self, setup: ScannerSetup, allow: Sequence[str]) -> list[str]:
        """Return warnings about differences that are allowed; raise `InputError` for those that are not."""
        for name in allow:
            one_of(name, ALLOWED, "allow")
        differing = self.contents.differing(setup)
        if refused := [name for name in differing if name not in allow]:
            names = " and ".join(refused)
            raise InputError(f"{self.path}: trained for another {names}; --allow {' '.join(refused)} takes it anyway")
        return [f"{self.path.name} was trained for another {name}, which was allowed" for name in differing]

    def _count_differences(self, counts: float) -> list[str]:
        """Return a list with a warning if a scan has far fewer or more counts than the training data, else an empty one."""
        smallest, largest = self.contents.counts
        if smallest / _COUNTS_FACTOR <= counts <= largest * _COUNTS_FACTOR:
            return []
        return [f"{self.path.name} was trained on {smallest:.3g} to {largest:.3g} counts, this scan has {counts:.3g}"]


def read_model(path: AnyPath) -> TrainedNetwork:
    """Read the network of a model file; raise `InputError` if it is damaged or holds anything but data."""
    contents, digest = _read_contents(Path(path))
    return TrainedNetwork(Path(path), digest, contents)


def with_judgement(path: AnyPath, judgement: Mapping[str, Any]) -> TrainedNetwork:
    """Write the judge's record, any JSON values, into a model file, and return the network."""
    write_model(replace(read_model(path).contents, judgement=judgement), path)
    return read_model(path)
