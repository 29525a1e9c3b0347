"""Model files (.pt): a network's weights, and what it was trained on, for and how well; reading one runs none of it.

The file is one of `torch.save`, so a zip, whose comment holds the SHA-256 of all bytes before the digest. Only tensors,
texts and numbers in it are read.
"""

import hashlib
import io
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
from ..files import AnyPath, read_bytes, require_ending, write_bytes
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
from .recipe import TrainingRecipe, parsed
from .setup import Setup

_FORMAT, _VERSION = "mphDRR network", 1
_SEAL = b"mphDRR sha256 "
_DIGEST = 64  # characters
_END = b"PK\x05\x06"  # of a zip's last record, which without a comment has 22 bytes
ALLOWED = ("scanner", "grid", "physics")
"""What may be allowed to differ from what a network was trained for."""
_NO_PHYSICS = ("time", "background")
"""Entries of a model's record that may differ: a network is given counts and background of each scan."""
_LATER = {
    "start": 0.0, "efficiency": 1.0, "energy_fwhm": None, "lines": "together", "plate_thickness": None,
    "wall_thickness": None,
}  # fmt: skip
"""Entries that records of earlier versions lack, and what they stand for."""
_KEPT = 4
_SETUPS: dict[Any, Setup] = {}
"""Setups that all networks share, the last used last, and how many are kept."""
_FAR = 2.0  # times fewer or more counts than any that it was trained on


@dataclass(frozen=True, eq=False)
class Contents:
    """What a model file holds: the weights, and texts and numbers about them."""

    weights: Mapping[str, torch.Tensor]
    recipe: str  # TOML
    scanner: str  # `Setup.scanner`
    shape: Sequence[int]  # of the grid
    affine: Sequence[Sequence[float]]
    physics: str  # `Setup.physics`
    fixed: Mapping[str, Any]  # the network's arguments that followed from the setup
    counts: Sequence[float]  # fewest and most of a scan that it was trained on
    trained_on: Mapping[str, Any]
    """Events by their recipes' hashes; name of the set, hash, model, levels, number of samples."""
    curve: Sequence[Mapping[str, float]]
    judgement: Mapping[str, Any] | None = None
    versions: Mapping[str, str] = field(default_factory=versions)

    @cached_property
    def grid(self) -> Grid:
        """The voxels of its volumes."""
        n_x, n_y, n_z = self.shape
        return Grid((n_x, n_y, n_z), np.array(self.affine))

    def differing(self, setup: Setup) -> list[str]:
        """Which of `ALLOWED` are others than those that it was trained for."""
        is_same = {
            "scanner": setup.scanner == self.scanner,
            "grid": same_grid(setup.A.grid, self.grid),
            "physics": _physics(setup.physics) == _physics(self.physics),
        }
        return [name for name in ALLOWED if not is_same[name]]


def _physics(text: str) -> dict[str, Any]:
    known = _LATER | json.loads(text)
    times = known["time"] if isinstance(known.get("time"), list) else []  # one stands for all: then it is a scale
    return {name: value for name, value in known.items() if name not in _NO_PHYSICS} | {"times": times}


def write_model(contents: Contents, path: AnyPath) -> None:
    """Write a model file, sealed; `InputError` for another ending than .pt, or where it cannot be written."""
    require_ending(path, (".pt",))
    memory = io.BytesIO()
    about = {name: value for name, value in vars(contents).items() if name in Contents.__annotations__}
    weights = {name: values.detach().cpu().contiguous() for name, values in about.pop("weights").items()}
    torch.save({"format": _FORMAT, "version": _VERSION, "weights": weights, "about": json.dumps(about)}, memory)
    write_bytes(path, sealed(memory.getvalue()))


def sealed(data: bytes) -> bytes:
    """A zip without a comment, with one that seals it."""
    assert data[-22:-18] == _END and data[-2:] == bytes(2)
    data = data[:-2] + (len(_SEAL) + _DIGEST).to_bytes(2, "little") + _SEAL
    return data + hashlib.sha256(data).hexdigest().encode()


def _read(path: Path) -> tuple[Contents, str]:
    """What a file holds, and its digest; `InputError` where it is damaged or holds anything but data."""
    data = read_bytes(path)
    body, digest = data[:-_DIGEST], data[-_DIGEST:].decode("latin-1")
    with naming(path):
        if not body.endswith(_SEAL):
            raise InputError("no model file of mphDRR, or cut: its seal is missing")
        if hashlib.sha256(body).hexdigest() != digest:
            raise InputError("damaged: its bytes are not those that were written")
        with reading(path, "a model: it holds more than numbers and texts, nothing of which was run"):
            found = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        if not isinstance(found, dict) or found.get("format") != _FORMAT:
            raise InputError("no model file of mphDRR")
        if found["version"] != _VERSION:
            raise InputError(f"format {found['version']}; this mphDRR reads {_VERSION}, a newer one may read it")
        with reading(path, "a model file"):
            return Contents(found["weights"], **json.loads(found["about"])), digest


@dataclass(frozen=True, eq=False)
class TrainedNetwork:
    """A network of a model file: ``model(run)`` reconstructs a run.

    >>> model = mph.learning.read_model("model.pt")
    >>> volume = model(mph.read_run("run.h5"))
    """

    path: Path
    sha256: str
    contents: Contents

    def __call__(self, run: ProjectionRun, allow: Sequence[str] = ()) -> Volume:
        """The volume of a run by the same scanner and physics, on the network's grid.

        Parameters
        ----------
        run
            Simulated or measured, of counts.
        allow
            Which of "scanner", "grid" and "physics" may be others than those that it was trained for.

        Warns
        -----
        InputWarning
            What is allowed differs, or the run has far fewer or more counts than what it was trained on.
        """
        told = {"reconstruction.method": str(self.path), "reconstruction.allow": tuple(allow) or None}
        return reconstruct_run(run, run.recipe.updated(told), method=self.method).volume

    @cached_property
    def recipe(self) -> TrainingRecipe:
        """How it was trained."""
        return parsed(self.contents.recipe, f"{self.path}: its recipe")

    @cached_property
    def network(self) -> torch.nn.Module:
        """The network itself."""
        model = NETWORKS[self.recipe["network.kind"]].load()
        with reading(self.path, "weights of this version's network"):
            network: torch.nn.Module = model(**self.recipe.network, **self.contents.fixed)
            network.load_state_dict(dict(self.contents.weights))
        return network.eval()

    @property
    def label(self) -> str:
        """What it is called: that it is a network, which, and its file."""
        return f"Network {self.path.name} ({NETWORKS[self.recipe['network.kind']].label})"

    @property
    def method(self) -> Method:
        """It as a method of `reconstruct_run`."""
        text = NETWORKS[self.recipe["network.kind"]].text
        return Method(self.label, text, self.reconstruct, objective="", grid=self.contents.grid)

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of all that its volumes depend on: another one than that of its file once that holds a judge's table."""
        told = hashlib.sha256(repr((self.contents.recipe, self.contents.scanner, self.contents.physics)).encode())
        for name, values in sorted(self.contents.weights.items()):
            told.update(name.encode() + values.numpy().tobytes())
        return told.hexdigest()

    def judged(self, name: str) -> JudgedMethod:
        """It under a name in the judge's table; scanners and physics that it was not trained for are judged, too."""

        def volume(run: ProjectionRun) -> Volume:
            with recorded_warnings():  # the judge knows what differs
                return self(run, ("scanner", "physics"))

        return JudgedMethod(
            name, volume, self.fingerprint, self.contents.trained_on["events"], lambda: self._used[-1].saved
        )

    def setup(self, A: Projector) -> Setup:
        """What it is told of a scanner, kept for the next scans by it, and for other networks."""
        own = tuple(self.recipe[key] for key in ("osem.subsets", "osem.after", "network.permuted"))
        made = Setup(A, *own)
        if getattr(A.model, "mu", None) is not None:  # of which the record has the grid alone
            return made
        key = made.scanner, made.physics, A.grid.shape, A.grid.affine.tobytes(), own
        _SETUPS[key] = _SETUPS.pop(key, made)
        if len(_SETUPS) > _KEPT:
            del _SETUPS[next(iter(_SETUPS))]
        return _SETUPS[key]

    @cached_property
    def _used(self) -> list[Setup]:
        """The setup of the last scan, in a list of one."""
        return []

    def reconstruct(
        self,
        A: Projector,
        images: ArrayLike,
        allow: Sequence[str] = (),
        background: ArrayLike = 0.0,
        progress: Progress | None = None,
    ) -> Reconstruction:
        """The volume that counts are of.

        Parameters
        ----------
        A : Projector
            Of emission, on the grid that it was trained for.
        images
            Counts (M, n_v, n_u).
        allow
            As for a call.
        background
            Counts expected besides those of the volume and of the projector's model.
        progress
            Called before and after.
        """
        data, setup = CountData.of(self.label, A, images, background), self.setup(A)
        self._used[:] = [setup]
        doubts = [*self._allowed(setup, allow), *self._far(float(data.counts.sum()))]
        for text in doubts:
            warn(text, 2)
        tell(progress, 0, 1)
        sample = setup.sample(data.counts, np.array(data.background), np.zeros(A.shape_in, np.float32))
        with torch.no_grad():
            found = self.network(setup, sample)[-1][0, 0] * sample.scale[0]
        tell(progress, 1, 1)
        known = {
            "method": self.label, "network": self.recipe["network.kind"], "file": str(self.path), "sha256": self.sha256,
            "allow": list(allow), "flatters": doubts, "stopped": "iterations",
        }  # fmt: skip
        note = ". ".join([f"Reconstructed by a {self.label[0].lower()}{self.label[1:]}, sha256 {self.sha256}", *doubts])
        return Reconstruction(Volume(found.float().numpy(), A.grid, note=note), np.zeros(0), known)

    def _allowed(self, setup: Setup, allow: Sequence[str]) -> list[str]:
        """Words on what differs and is allowed; `InputError` where it is not."""
        for name in allow:
            one_of(name, ALLOWED, "allow")
        differing = self.contents.differing(setup)
        refused = [name for name in differing if name not in allow]
        if refused:
            words = " and ".join(refused)
            raise InputError(f"{self.path}: trained for another {words}; --allow {' '.join(refused)} takes it anyway")
        return [f"{self.path.name} was trained for another {name}, which was allowed" for name in differing]

    def _far(self, counts: float) -> list[str]:
        """Words on a scan of far fewer or more counts than the network has learned from."""
        fewest, most = self.contents.counts
        if fewest / _FAR <= counts <= most * _FAR:
            return []
        return [f"{self.path.name} was trained on {fewest:.3g} to {most:.3g} counts, this scan has {counts:.3g}"]


def read_model(path: AnyPath) -> TrainedNetwork:
    """The network of a model file; `InputError`, in one line, where the file is damaged or holds anything but data."""
    contents, digest = _read(Path(path))
    return TrainedNetwork(Path(path), digest, contents)


def with_judgement(path: AnyPath, judgement: Mapping[str, Any]) -> TrainedNetwork:
    """Write its judge's table, anything JSON can hold, into a model file."""
    write_model(replace(read_model(path).contents, judgement=judgement), path)
    return read_model(path)
