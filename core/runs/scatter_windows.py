"""Scatter in measured counts, estimated from frames of energy windows beside the photopeak's window."""

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
    """Frames of energy windows beside the photopeak's, from which `energy_window_scatter` estimates its scatter.

    Attributes
    ----------
    lower_frames, upper_frames
        Modules of the frames in the lower and the upper window, as `frames` of `counts_run`. None for no such window: the
        continuum then falls to 0 there.
    widths
        Widths of the lower, the peak and the upper window, keV. None for the widths in the files.
    fwhm
        FWHM, pixels, of the Gaussian that smooths the estimate. None for no smoothing.
    isotope, energy_fwhm
        Isotope, and FWHM of the energy resolution as in `Emission`: with both, the photopeak's tails in the outer windows
        are not counted as scatter, and the files must state the windows' energies. None: all counts there are scatter.
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
        """Modules of the frames by window, "lower" and "upper"; a missing window has no entry."""
        frames = {"lower": self.lower_frames, "upper": self.upper_frames}
        return {word: modules for word, modules in frames.items() if modules is not None}

    def estimate(
        self,
        images: Mapping[str, Floats32],
        used: Mapping[str, Sequence[int]],
        found: Counts,
        efficiency: float | Floats = 1.0,
    ) -> tuple[Floats, dict[str, Any]]:
        """Return the scatter (M, n_v, n_u) in the images of the peak window, and its record.

        Parameters
        ----------
        images, used
            Images (M, n_v, n_u), and the indices of their frames in `found`, by the windows "peak", "lower" and "upper".
        found
            Frames of the files, with the energies and exposures that the files state.
        efficiency
            Detection efficiency of the images.

        Raises
        ------
        InputError
            The files state other windows or exposures, or the windows' widths are unknown.
        """
        _require_frames_of_windows(used, found)
        widths = [None if word not in used else self._width(word, used[word], found) for word in _WORDS]
        (lower, peak, upper) = map(images.get, _WORDS)
        assert peak is not None
        shares = None
        if self.isotope is not None and self.energy_fwhm is not None:
            edges = [None if word not in used else self._edges(word, used[word], found) for word in _WORDS]
            shares = peak_shares(isotope(self.isotope), edges, self.energy_fwhm)
        scatter, _ = energy_window_scatter(lower, peak, upper, widths, self.fwhm, with_image_axes(efficiency), shares)
        scatter = scatter.clip(min=0)  # a background cannot be negative
        window_counts = sum(images[word].sum(axis=(1, 2), dtype=float) for word in self.frames)
        record = {"windows": sorted(self.frames), "widths_keV": widths, "fwhm_pixels": self.fwhm}
        record |= {} if shares is None else {"shares_of_peak": list(shares)}
        return scatter, record | {"counts": np.asarray(window_counts).tolist()}

    @staticmethod
    def _edges(word: str, used: Sequence[int], counts: Counts) -> tuple[float, float]:
        """Return the lowest and the highest energy, keV, of a window, which its frames must have in common."""
        low, high = counts.about[used[0], -2:].tolist()
        if not (np.isfinite(low + high) and (counts.about[used, -2:] == counts.about[used[0], -2:]).all()):
            expected = f"the {word} window's energies, the same of all frames"
            raise InputError(f"{counts.name}: the peak's tails need {expected}")
        return low, high

    def _width(self, word: str, used: Sequence[int], counts: Counts) -> float:
        """Return the width of a window, keV, from `widths`, which must agree with the files, or from the files."""
        width = None if self.widths is None else float(self.widths[_WORDS.index(word)])
        file_widths = {round(high - low, 3) for low, high in counts.about[used, -2:] if np.isfinite(low + high)}
        widths = " and ".join(f"{value:g}" for value in sorted(file_widths))
        text = f"{counts.name}: the file says a {word} window of {widths} keV"
        if len(file_widths) > 1:
            raise InputError(f"{text}; expected frames of one width")
        if width is None and not file_widths:
            advice = "say it (--window-widths LOWER PEAK UPPER)"
            raise InputError(f"{counts.name}: it does not say how wide the energy windows are; {advice}")
        if width is None:
            return file_widths.pop()
        if any(differs(value, width) for value in file_widths):
            raise InputError(f"{text}, not {width:g} (--window-widths)")
        return width


def _require_frames_of_windows(used: Mapping[str, Sequence[int]], counts: Counts) -> None:
    """Raise `InputError` for frames in two windows, at energies on the wrong side of the peak, or of another exposure."""
    for word, side in (("lower", -1), ("upper", 1)):
        for peak_frame, window_frame in zip(used["peak"], used.get(word, ()), strict=False):
            place = f"{word}_frames (--{word}-frames): frame {window_frame + 1}"
            if window_frame in used["peak"] or (word == "upper" and window_frame in used.get("lower", ())):
                raise InputError(f"{place} is of another window, too")
            peak_energy, energy = counts.about[peak_frame, -2:].mean(), counts.about[window_frame, -2:].mean()
            if side * (energy - peak_energy) < 0:
                raise InputError(f"{place} is of energies around {energy:g} keV, the peak's around {peak_energy:g} keV")
            if differs(counts.about[window_frame, 0], counts.about[peak_frame, 0]):
                times = f"{counts.about[window_frame, 0]:g} s, the peak's {counts.about[peak_frame, 0]:g} s"
                raise InputError(f"{place}: the file says an exposure of {times}; expected the same")
