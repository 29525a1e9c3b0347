"""Scatter in measured counts, found from frames of energy windows beside the peak's."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Floats, Floats32
from ..errors import InputError
from ..models.model import with_image_axes
from ..physics.energy_window import energy_window_scatter, peak_shares
from ..physics.isotopes import isotope
from .frame_files import Counts, differs

_WORDS = ("lower", "peak", "upper")


@dataclass(frozen=True)
class ScatterWindows:
    """Frames of energy windows beside the peak's, from which `energy_window_scatter` estimates the scatter in it.

    Attributes
    ----------
    lower_frames, upper_frames
        Which module each frame is of, as `frames` of `counts_run`; None: there is no such window, and the continuum falls
        to 0 there.
    widths
        Widths of the lower, the peak and the upper window, keV. None: what the files say.
    fwhm
        FWHM in pixels of the Gaussian that smooths the estimate. None: it is not smoothed.
    isotope, energy_fwhm
        With both, the photopeak's tails in the outer windows are no scatter: the FWHM of the energy resolution is that of
        `Emission`. The files must say the windows' energies. None: all that is in the outer windows is scatter.
    """

    lower_frames: str | Sequence[int | None] | None = None
    upper_frames: str | Sequence[int | None] | None = None
    widths: Sequence[float] | None = None
    fwhm: float | None = None
    isotope: str | None = None
    energy_fwhm: float | None = None

    def __post_init__(self) -> None:
        if self.lower_frames is None and self.upper_frames is None:
            expected = "lower_frames (--lower-frames) or upper_frames (--upper-frames), or both"
            raise InputError(f"scatter: expected {expected}")
        if self.widths is not None and len(self.widths) != 3:
            raise InputError(f"scatter: expected widths of three windows, got {len(self.widths)}")

    @property
    def frames(self) -> dict[str, Any]:
        """Which module each frame is of, by the windows "lower" and "upper" that there are."""
        given = {"lower": self.lower_frames, "upper": self.upper_frames}
        return {word: frames for word, frames in given.items() if frames is not None}

    def estimate(
        self,
        images: Mapping[str, Floats32],
        used: Mapping[str, Sequence[int]],
        found: Counts,
        efficiency: float | Floats = 1.0,
    ) -> tuple[Floats, dict[str, Any]]:
        """The scatter (M, n_v, n_u) in the images of the window "peak", and what is recorded of it.

        `images` and the frames `used` for them, in the modules' order, are by the windows "peak", "lower" and "upper"; the
        `efficiency` is that of the images.
        `InputError` where the files say other windows or exposures, or nothing says the windows' widths.
        """
        _require_own_frames(used, found)
        widths = [None if word not in used else self._width(word, used[word], found) for word in _WORDS]
        (lower, peak, upper) = map(images.get, _WORDS)
        assert peak is not None
        shares = None
        if self.isotope is not None and self.energy_fwhm is not None:
            edges = [None if word not in used else self._edges(word, used[word], found) for word in _WORDS]
            shares = peak_shares(isotope(self.isotope), edges, self.energy_fwhm)
        scatter, _ = energy_window_scatter(lower, peak, upper, widths, self.fwhm, with_image_axes(efficiency), shares)
        scatter = scatter.clip(min=0)  # a background cannot be less
        beside = sum(images[word].sum(axis=(1, 2), dtype=float) for word in self.frames)
        record = {"windows": sorted(self.frames), "widths_keV": widths, "fwhm_pixels": self.fwhm}
        record |= {} if shares is None else {"shares_of_peak": list(shares)}
        return scatter, record | {"counts": np.asarray(beside).tolist()}

    @staticmethod
    def _edges(word: str, used: Sequence[int], found: Counts) -> tuple[float, float]:
        """The energies between which the frames of a window are, keV."""
        low, high = found.about[used[0], -2:].tolist()
        if not (np.isfinite(low + high) and (found.about[used, -2:] == found.about[used[0], -2:]).all()):
            needed = f"the {word} window's energies, the same of all frames"
            raise InputError(f"{found.name}: the peak's tails need {needed}")
        return low, high

    def _width(self, word: str, used: Sequence[int], found: Counts) -> float:
        """The width of a window, keV: what is given, unless a file contradicts it, or what the files say."""
        given = None if self.widths is None else float(self.widths[_WORDS.index(word)])
        said = {round(high - low, 3) for low, high in found.about[used, -2:] if np.isfinite(low + high)}
        widths = " and ".join(f"{width:g}" for width in sorted(said))
        text = f"{found.name}: the file says a {word} window of {widths} keV"
        if len(said) > 1:
            raise InputError(f"{text}; expected frames of one width")
        if given is None and not said:
            advice = "say it (--window-widths LOWER PEAK UPPER)"
            raise InputError(f"{found.name}: it does not say how wide the energy windows are; {advice}")
        if given is None:
            return said.pop()
        if any(differs(width, given) for width in said):
            raise InputError(f"{text}, not {given:g} (--window-widths)")
        return given


def _require_own_frames(used: Mapping[str, Sequence[int]], found: Counts) -> None:
    """Refuse frames that are of two windows, of windows on the wrong side of the peak's, or of another exposure."""
    for word, side in (("lower", -1), ("upper", 1)):
        for k, other in zip(used["peak"], used.get(word, ()), strict=False):
            where = f"{word}_frames (--{word}-frames): frame {other + 1}"
            if other in used["peak"] or (word == "upper" and other in used.get("lower", ())):
                raise InputError(f"{where} is of another window, too")
            mine, its = found.about[k, -2:].mean(), found.about[other, -2:].mean()
            if side * (its - mine) < 0:
                raise InputError(f"{where} is of energies around {its:g} keV, the peak's around {mine:g} keV")
            if differs(found.about[other, 0], found.about[k, 0]):
                times = f"{found.about[other, 0]:g} s, the peak's {found.about[k, 0]:g} s"
                raise InputError(f"{where}: the file says an exposure of {times}; expected the same")
