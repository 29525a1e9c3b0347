"""All scores that a volume can have beside its truth, as numbers, as lines of a table, and as a record for JSON."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...arrays import ArrayLike, Floats
from ...errors import InputError
from ...geometry.frames import checked_affine
from ...geometry.grid import same_grid
from ...phantoms.derenzo import DerenzoRods
from ...phantoms.nema import NemaBody
from ...phantoms.phantom import QUANTITIES, Phantom
from ...progress import Progress
from ...validation import instance
from ...volumes.resampling import resample
from ...volumes.volume import Volume, require_quantity
from .derenzo import DerenzoScore, derenzo_score
from .images import nrmse, psnr, ssim
from .nema import NemaScore, NemaSphere, nema_score


@dataclass(frozen=True, eq=False)
class VolumeScore:
    """The scores of a volume beside its truth; those that it cannot have are None, and `notes` say why."""

    volume: Volume
    truth: Volume
    """On the volume's grid."""
    nrmse: float
    psnr: float
    """dB."""
    ssim: float | None
    derenzo: DerenzoScore | None = None
    """If the truth is a phantom with Derenzo rods."""
    nema: NemaScore | None = None
    """If the truth is a NEMA body phantom."""
    phantom: Phantom | None = None
    """The truth, if it is a phantom."""
    pose: Floats = field(default_factory=lambda: np.eye(4))
    """World-from-phantom (4, 4), mm."""
    notes: tuple[str, ...] = ()
    """What the scores were made with, and why some are missing: a sentence each."""

    @property
    def lines(self) -> list[str]:
        """The scores in words: lines of text, columns under each other."""
        similarity = "" if self.ssim is None else f", SSIM {self.ssim:.3f}"
        lines = [f"All voxels: NRMSE {self.nrmse:.3f}, PSNR {_number(self.psnr, '.1f')} dB{similarity}"]
        if self.derenzo is not None:
            said = ((s.rod_diameter, ": ".join(filter(None, (s.light, s.words)))) for s in self.derenzo)
            lines += [f"{diameter:g} mm  {words}" for diameter, words in said if diameter]
        if self.nema is not None:
            lines += _table(("Spheres", "contrast recovery", "background variability"), map(_sphere_row, self.nema))
            if not math.isnan(self.nema.lung_residual):
                lines.append(f"Lung insert: {self.nema.lung_residual:.1f} % of the background remain")
        return lines

    @property
    def record(self) -> dict[str, Any]:
        """The scores as JSON can hold them: what is not known is None."""
        record: dict[str, Any] = {"nrmse": self.nrmse, "psnr_dB": _finite(self.psnr), "ssim": self.ssim}
        if self.derenzo is not None:
            names = ("rod_diameter", "valley_to_peak", "contrast_recovery", "chance", "pairs_resolved")
            record["derenzo"] = [
                {**{name: _finite(getattr(s, name)) for name in names}, "pairs": len(s.profiles), "note": s.note,
                 "light": s.light or None,
                 "resolved": None if math.isnan(s.resolved) else bool(s.resolved)}
                for s in self.derenzo
            ]  # fmt: skip
        if self.nema is not None:
            columns = ("diameter", "contrast_recovery", "background_variability")
            record["nema"] = [{name: getattr(s, name) for name in columns} for s in self.nema]
            record["lung_residual"] = _finite(self.nema.lung_residual)
        return {**record, "notes": list(self.notes)}


def score_volume(
    volume: Volume, truth: Volume | Phantom, pose: ArrayLike | None = None, progress: Progress | None = None
) -> VolumeScore:
    """Every score that `volume` can have beside its truth: `nrmse`, `psnr`, `ssim`, and those of a phantom.

    Parameters
    ----------
    volume
        A volume, such as a reconstruction's.
    truth
        A volume of the same quantity: one on another grid is resampled onto the volume's, as means, and a note says so. Or a
        phantom: it is voxelized on the volume's grid, and `derenzo_score` or `nema_score` are made where it has rods or
        spheres for them.
    pose
        World-from-phantom (4, 4), mm; only of a phantom.
    progress
        Called as ``progress(done, total)``; may raise `Cancelled`.

    Raises
    ------
    InputError
        If the quantities differ, the truth is the same everywhere, or `pose` is given with a volume.
    """
    instance(volume, Volume, "score_volume")
    if isinstance(truth, Phantom):
        require_quantity(volume.quantity, QUANTITIES, "score_volume")
        world = np.eye(4) if pose is None else checked_affine(pose, "phantom pose")
        voxels = truth.voxelize(volume.grid, world, progress, volume.quantity)
        return _scored(volume, voxels, phantom=truth, pose=world)
    instance(truth, Volume, "score_volume: truth")
    if pose is not None:
        raise InputError("score_volume: a pose is that of a phantom; a volume's place is in its grid")
    if truth.quantity != volume.quantity:
        raise InputError(f"score_volume: volume of {volume.quantity}, truth of {truth.quantity}")
    if same_grid(volume.grid, truth.grid):
        return _scored(volume, truth)
    note = "the truth, on another grid, is resampled onto the volume's voxels, as means"
    return _scored(volume, resample(truth, volume.grid, "mean", progress=progress), notes=(note,))


def _scored(
    volume: Volume, truth: Volume, notes: tuple[str, ...] = (), phantom: Phantom | None = None, pose: Any = None
) -> VolumeScore:
    wanted: dict[str, Callable[[], Any]] = {"SSIM": lambda: ssim(volume, truth)}
    if phantom is not None and any(isinstance(shape, DerenzoRods) for shape in phantom.shapes):
        wanted["rods"] = lambda: derenzo_score(volume, phantom, pose)
    if isinstance(phantom, NemaBody):
        wanted["spheres"] = lambda: nema_score(volume, phantom, pose)
    found: dict[str, Any] = {}
    for name, score in wanted.items():
        try:
            found[name] = score()
        except InputError as error:
            notes = (*notes, f"without {name}: {error}")
    return VolumeScore(
        volume, truth, nrmse(volume, truth), psnr(volume, truth), found.get("SSIM"), found.get("rods"),
        found.get("spheres"), phantom, np.eye(4) if pose is None else pose, notes,
    )  # fmt: skip


def _sphere_row(sphere: NemaSphere) -> tuple[str, ...]:
    percents = (f"{percent:.1f} %" for percent in (sphere.contrast_recovery, sphere.background_variability))
    return f"{sphere.diameter:g} mm", *percents


def _table(heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> list[str]:
    """Lines with columns under each other, numbers to the right."""
    every = [heads, *rows]
    widths = [max(map(len, column)) for column in zip(*every, strict=True)]
    return ["  ".join([f"{row[0]:<{widths[0]}}", *map(str.rjust, row[1:], widths[1:])]) for row in every]


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "infinite" if math.isinf(value) else "-"


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
