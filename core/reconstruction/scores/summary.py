"""Table of the scores of a volume beside its truth, and all of them together: numbers, lines of text, a record for JSON."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from ...arrays import ArrayLike, Floats
from ...errors import InputError, warn
from ...geometry.frames import checked_affine
from ...geometry.grid import same_grid
from ...phantoms.derenzo import DerenzoRods
from ...phantoms.nema import NemaBody
from ...phantoms.phantom import QUANTITIES, Phantom
from ...progress import Progress
from ...validation import instance
from ...volumes.resampling import outside_warnings, resample
from ...volumes.volume import Volume, require_quantity
from .derenzo import DerenzoScore, derenzo_score
from .images import WINDOW, nrmse, psnr, ssim
from .nema import NemaScore, nema_score
from .rows import json_number


class Score(NamedTuple):
    """Row of `SCORES`: a number computed from all voxels, or a `Rows` object with the scores of a phantom's parts."""

    name: str
    """Attribute of `VolumeScore`; with the unit, the key in the record."""
    label: str
    """Name in lines of text, and in the note that says why the score is missing."""
    function: Callable[..., Any]
    """Function of the volume and the truth on its grid, or of the volume, the phantom and its pose."""
    fits: Callable[[Phantom], bool] | None = None
    """Function that returns whether a phantom has the scored parts; None for a number computed from all voxels."""
    form: str = ""
    """Format of the number in lines of text."""
    unit: str = ""
    required: bool = False
    """Whether a volume without this score has no scores at all; else it gets a note that says why the score is missing."""
    in_window: bool = False
    """Whether Blender's panel shows the number."""
    judged_from: int = 0
    """Voxels along each axis from which on the judge computes the number, too; 0: it does not."""


SCORES = (
    Score("nrmse", "NRMSE", nrmse, form=".3f", required=True, in_window=True),
    Score("psnr", "PSNR", psnr, form=".1f", unit="dB", required=True),
    Score("ssim", "SSIM", ssim, form=".3f", judged_from=WINDOW),
    Score("derenzo", "rods", derenzo_score, lambda p: any(isinstance(s, DerenzoRods) for s in p.shapes)),
    Score("nema", "spheres", nema_score, lambda p: isinstance(p, NemaBody)),
)
JUDGED_SCORES = [score for score in SCORES if score.judged_from]
"""Scores that the judge computes beside NRMSE."""


@dataclass(frozen=True, eq=False)
class VolumeScore:
    """Scores of a volume beside its truth; a score that the volume cannot have is None, and `notes` say why.

    The scores of further rows of the tables are attributes, too.
    """

    volume: Volume
    truth: Volume
    """Truth on the volume's grid."""
    nrmse: float
    """Normalised root mean square error, see `nrmse`."""
    psnr: float
    """Peak signal-to-noise ratio, dB."""
    ssim: float | None
    """Structural similarity, see `ssim`."""
    derenzo: DerenzoScore | None = None
    """Scores of the rods, if the truth is a phantom with Derenzo rods."""
    nema: NemaScore | None = None
    """Scores of the spheres, if the truth is a NEMA body phantom."""
    phantom: Phantom | None = None
    """Phantom that the truth was made from, if any."""
    pose: Floats = field(default_factory=lambda: np.eye(4))
    """World-from-phantom matrix (4, 4), mm."""
    notes: tuple[str, ...] = ()
    """Sentences that say how the scores were made, and why some are missing."""
    more: Mapping[str, Any] = field(default_factory=dict)
    """Scores of further rows of `SCORES`, by name; they are attributes, too."""

    def __getattr__(self, name: str) -> Any:
        if name == "more" or name not in self.more:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return self.more[name]

    @property
    def lines(self) -> list[str]:
        """The scores as lines of text, with aligned columns."""
        numbers = [f"{row.label} {_number(score, row.form)} {row.unit}".rstrip() for row, score in self._scores(False)]
        return [f"All voxels: {', '.join(numbers)}", *(line for _, score in self._scores(True) for line in score.lines)]

    @property
    def record(self) -> dict[str, Any]:
        """The scores as JSON can hold them, None for an unknown number."""
        rows = [row for row in SCORES if not row.fits]
        numbers = {"_".join(filter(None, (row.name, row.unit))): getattr(self, row.name) for row in rows}
        parts = {key: value for _, score in self._scores(True) for key, value in score.record.items()}
        return {**{key: json_number(value) for key, value in numbers.items()}, **parts, "notes": list(self.notes)}

    @property
    def cells(self) -> list[tuple[str, str]]:
        """Names and values, as text, for the table of Blender's panel."""
        numbers = [(row.label, f"{score:.3g}") for row, score in self._scores(False) if row.in_window]
        return [*numbers, *(cell for _, score in self._scores(True) for cell in score.cells)]

    def _scores(self, of_parts: bool) -> list[tuple[Score, Any]]:
        """Return the scores that the volume has, with their rows: those of all voxels, or of the phantom's parts."""
        rows = (row for row in SCORES if (row.fits is not None) == of_parts)
        return [(row, score) for row in rows if (score := getattr(self, row.name)) is not None]


def score_volume(
    volume: Volume, truth: Volume | Phantom, pose: ArrayLike | None = None, progress: Progress | None = None
) -> VolumeScore:
    """Compute every score that `volume` can have beside its truth: `nrmse`, `psnr`, `ssim`, and those of a phantom.

    Parameters
    ----------
    volume
        Volume to score, such as a reconstruction's.
    truth
        Volume of the same quantity, or phantom. A volume on another grid is resampled onto the grid of `volume`, as means,
        and a note says so. A phantom is voxelized on that grid, and scored by `derenzo_score` or `nema_score` if it has rods
        or spheres for them.
    pose
        World-from-phantom matrix (4, 4), mm; only for a phantom.
    progress
        Called as ``progress(done, total)``; may raise `Cancelled`.

    Raises
    ------
    InputError
        The quantities differ, the truth is the same everywhere, or `pose` is given with a volume.
    """
    instance(volume, Volume, "score_volume")
    if isinstance(truth, Phantom):
        require_quantity(volume.quantity, QUANTITIES, "score_volume")
        world = np.eye(4) if pose is None else checked_affine(pose, "phantom pose")
        voxels = truth.voxelize(volume.grid, world, progress, volume.quantity)
        return _all_scores(volume, voxels, phantom=truth, pose=world)
    instance(truth, Volume, "score_volume: truth")
    if pose is not None:
        raise InputError("score_volume: a pose is that of a phantom; a volume's place is in its grid")
    if truth.quantity != volume.quantity:
        raise InputError(f"score_volume: volume of {volume.quantity}, truth of {truth.quantity}")
    if same_grid(volume.grid, truth.grid):
        return _all_scores(volume, truth)
    for text in outside_warnings(truth, volume.grid, "the volume", "where it is not scored"):
        warn(text)
    note = "the truth, on another grid, is resampled onto the volume's voxels, as means"
    return _all_scores(volume, resample(truth, volume.grid, "mean", progress=progress), notes=(note,))


def _all_scores(volume: Volume, truth: Volume, notes: tuple[str, ...] = (), **phantom: Any) -> VolumeScore:
    """Return all scores of a volume beside a truth on its grid, and beside the phantom and pose given by name, if any."""
    scores: dict[str, Any] = dict.fromkeys(row.name for row in SCORES)
    for row in SCORES:
        if row.fits is None or (phantom and row.fits(phantom["phantom"])):
            try:
                scores[row.name] = row.function(volume, *((truth,) if row.fits is None else phantom.values()))
            except InputError as error:
                if row.required:
                    raise
                notes = (*notes, f"without {row.label}: {error}")
    names = {f.name for f in fields(VolumeScore)}
    more = {name: scores.pop(name) for name in scores.keys() - names}
    return VolumeScore(volume, truth, **scores, **phantom, notes=notes, more=more)


def _number(value: float, form: str) -> str:
    """Return a number as text, in a format if it is finite."""
    return format(value, form) if math.isfinite(value) else "infinite" if math.isinf(value) else "-"
