"""Scattered photons in the panels of X-ray tubes, by the histories of `core.scatter`."""

import math
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Floats, Floats32
from ..errors import InputError
from ..geometry.views import Views
from ..memory import require
from ..physics.ct_numbers import CT_ENERGY
from ..physics.mass_attenuation import HIGHEST_ENERGY
from ..progress import Progress, tell
from ..rays.parallel import in_order, thread_count
from ..scatter.body import LOWEST_XRAY_ENERGY, Body
from ..scatter.histories import Histories, quasi_random
from ..validation import freeze, instance, positive, seed_number, strict_whole
from ..volumes.volume import Volume, require_quantity
from .scan import WATER_AND_BONE, SpectralScan
from .spectra import Spectrum

_BINS = 10  # most rows and columns of bins of a panel: scatter is smooth
_PLACES = 16  # places of the panel that each collision sees
_ENERGIES = 512  # number of the energies of the tables
_ROUNDS = 16  # independent rounds of histories, by whose differences deviations are known
_PILOT = 256  # histories of a round before the number of further ones is known
_METER = 1000.0  # mm


@dataclass(frozen=True, eq=False)
class XrayScatter:
    """Images of scattered photons in panels, with what is known of their accuracy."""

    images: Floats32
    """Expected signal (M, n_v, n_u) of scattered photons in each view and pixel, counts or keV."""
    deviation: Floats32
    """Standard deviations (M, n_v, n_u) of `images`, by the differences of rounds of histories."""
    precision: Floats
    """Standard deviations (M,) of the panels' totals, as shares of them; 0 where nothing is scattered."""
    histories: int
    """Number of photons that were followed, of all views."""
    by_order: Floats32 | None = None
    """Images (orders, M, n_v, n_u) of photons by their number of collisions, the last with all further ones; or None."""


def xray_scatter(
    body: Volume,
    views: Views,
    model: SpectralScan,
    *,
    histories: int | None = None,
    precision: float = 0.005,
    orders: int = 1,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | None = None,
) -> XrayScatter:
    """Compute the images of photons of X-ray tubes that are scattered in a body before they meet the panel.

    The views are exposed one after another, without a grid. Photons leave each focal spot within the cone to its own panel,
    with the energies of the tube's spectrum behind its filters, and are followed as by `scatter_images`. At each collision
    the chance that the photon is scattered to each of 16 random places of the panel, and what remains of it on the way
    there at its new energy, are added to a grid of at most 10 x 10 bins, with the panel's response. The pixels' images are
    smooth curves with the same totals in each bin.

    Parameters
    ----------
    body : Volume
        CT numbers ("hu"), or attenuation coefficients ("mu", 1/mm) at `CT_ENERGY`, 70 keV, on any grid.
    views : Views
        The model's views, such as ``system.views()``.
    model : SpectralScan
        Tubes and panels, with the materials "water-bone". Its background and blur do not matter.
    histories : int, optional
        Number of histories of each view. None: as many as `precision` takes.
    precision : float
        Relative standard deviation of each panel's total, up to which histories go on. That of single bins is some four
        times as large.
    orders : int
        Number of orders of scattering whose images are kept apart; the last has all from it on.
    seed : int
        Seed of the random numbers: the same gives the same images, whatever the number of threads.
    threads : int, optional
        Number of threads, by default one per core; each computes a view.
    progress : callable, optional
        Called as ``progress(done, total)`` after each view; may raise `Cancelled`.

    Returns
    -------
    XrayScatter
        Images (M, n_v, n_u) in the unit of the model's own, their standard deviations, precision.

    Raises
    ------
    InputError
        The model has other materials, the volume holds another quantity or values below 0, or no photon that the panel
        counts is within 10 to 1000 keV.

    Notes
    -----
    Give the images to the logarithm as the model's background: ``replace(model, background=scatter.images)``. Photons of
    less than 10 keV, and those that the panel or anything beside the body scatters, are not simulated.
    """
    instance(body, Volume, "scatter: body")
    instance(model, SpectralScan, "scatter: model")
    require_quantity(body.quantity, ("hu", "mu"), "scatter: body")
    if model.materials != WATER_AND_BONE:
        raise InputError(f"scatter: model: expected the materials {WATER_AND_BONE!r}, got {model.materials!r}")
    model.check(views)
    orders = strict_whole(orders, "scatter: orders", "1 or more")
    histories = None if histories is None else strict_whole(histories, "scatter: histories", "1 or more")
    precision = positive(precision, "scatter: precision")
    require(4.0 * (2 * orders + 2) * len(views) * math.prod(views.shape), f"scatter in {len(views)} panels")
    voxels, seed, threads = Body.of(body, CT_ENERGY), seed_number(seed), thread_count(threads)
    tables = {m: (spectrum, *_tables(spectrum, model)) for indices, spectrum in model.spectra() for m in indices}

    def simulate(m: int) -> tuple[Array, Array, float, int]:
        """Return the images (orders, n_v, n_u) of view m, their deviation, the precision of the total, and the histories."""
        spectrum, energies, response = tables[m]
        cone = _Cone(views, m, spectrum)
        view_seed = int(np.random.SeedSequence([seed, m]).generate_state(1, np.uint64)[0])
        rounds, count = _rounds(voxels, cone, energies, response, orders, view_seed, histories, precision)
        along_v, along_u = (_pixel_shares(bins, pixels) for bins, pixels in zip(cone.bins, views.shape, strict=True))
        scale = cone.photons * model.system.mas[m] / (count / _ROUNDS)
        variance = rounds.sum(axis=1).var(axis=0, ddof=1) / _ROUNDS
        images = along_v @ (scale * rounds.mean(axis=0)) @ along_u.T
        return images, scale * np.sqrt(along_v**2 @ variance @ along_u.T**2), _relative_error(rounds), count

    results = []
    for m, result in enumerate(in_order(simulate, range(len(views)), threads), 1):
        results.append(result)
        tell(progress, m, len(views))
    images, deviation = (np.array([result[i] for result in results], np.float32) for i in (0, 1))
    return XrayScatter(
        images=freeze(images.sum(axis=1)),
        deviation=freeze(deviation),
        precision=freeze(np.array([result[2] for result in results])),
        histories=sum(result[3] for result in results),
        by_order=freeze(np.ascontiguousarray(images.swapaxes(0, 1))) if orders > 1 else None,
    )


def _tables(spectrum: Spectrum, model: SpectralScan) -> tuple[Floats, Floats32]:
    """Return the energies (n,), keV, of the tables of a spectrum's photons, and the response (1, 1, n) to them."""
    highest = float(spectrum.energies[-1])
    expected = f"photons between {LOWEST_XRAY_ENERGY:g} and {HIGHEST_ENERGY:g} keV, of which there are tables"
    if highest <= LOWEST_XRAY_ENERGY:
        raise InputError(f"scatter: expected {expected}; the spectrum ends at {highest:g} keV")
    energies = np.linspace(LOWEST_XRAY_ENERGY, highest, 4 * _ENERGIES)
    counted = np.flatnonzero(model.photon_signals(energies))
    lowest = energies[max(min(counted, default=0) - 1, 0)]
    energies = np.linspace(min(lowest, highest - 0.1), highest, _ENERGIES)
    return energies, np.asarray(model.photon_signals(energies)[None, None], np.float32)


class _Cone:
    """Photons of a tube within the cone to its panel, as `Beginnings`."""

    def __init__(self, views: Views, m: int, spectrum: Spectrum) -> None:
        from ..rays.backends.cpu import PANEL

        is_followed = spectrum.energies > LOWEST_XRAY_ENERGY
        self._energies, photons = spectrum.energies[is_followed], spectrum.photons[is_followed]
        self._until = np.cumsum(photons) / photons.sum()
        self._source = views.sources[m]
        self._u, self._v = views.u_steps[m] * views.shape[1], views.v_steps[m] * views.shape[0]
        self._corner = views.detector_centers[m] - (self._u + self._v) / 2
        self._area = np.cross(self._u, self._v)
        self._area *= np.sign(self._area @ (self._corner - self._source))
        self.bins = tuple(min(n, _BINS) for n in views.shape)
        """Rows and columns of the panel's bins."""
        self.panel = np.array([(self._corner, self._u, self._v, self._area, *self.bins[::-1], _PLACES)], PANEL)
        """The panel (1,), of the type `rays.backends.cpu.PANEL`."""
        self._middle_angle = float(self._angles(views.detector_centers[m] - self._source))
        self.photons = float(photons.sum()) * _METER**2 * self._middle_angle
        """Photons per mAs that a photon of weight 1 stands for, if all places of the panel begin one."""

    def _angles(self, ways: Floats) -> Floats:
        """Return the solid angle (...,) of the panel, sr, if all of it were at the ends of `ways` (..., 3), mm."""
        return ways @ self._area / np.linalg.norm(ways, axis=-1) ** 3

    def starts(self, first: int, end: int, seed: int, all_first: int) -> Array:
        """Return the photons from number `first` to `end` of those from `all_first` on, as `rays.backends.cpu.START`."""
        from ..rays.backends.cpu import START

        shares = quasi_random(first, end, seed, all_first)
        ways = self._corner - self._source + shares[:, :1] * self._u + shares[:, 1:2] * self._v
        starts = np.empty(end - first, START)
        starts["place"], starts["weight"] = self._source, self._angles(ways) / self._middle_angle
        starts["direction"] = ways / np.linalg.norm(ways, axis=1, keepdims=True)
        starts["energy"] = self._energies[np.minimum(np.searchsorted(self._until, shares[:, 2]), len(self._until) - 1)]
        starts["collides_at"] = shares[:, 3]
        return starts


def _rounds(
    body: Body,
    cone: _Cone,
    energies: Floats,
    response: Floats32,
    orders: int,
    seed: int,
    wanted_histories: int | None,
    precision: float,
) -> tuple[Floats, int]:
    """Return the sums (rounds, orders, rows, columns) of the bins, for a photon per history, and the number of histories."""
    cells = math.prod(cone.bins)
    histories = Histories(body, cone, cone.panel, energies, response, np.zeros(0), cells, orders, seed, 1, False)
    rounds = np.zeros((_ROUNDS, orders, *cone.bins))
    missing = _PILOT if wanted_histories is None else -(-wanted_histories // _ROUNDS)
    while missing:
        for sums in rounds:
            histories.run(missing)
            sums += histories.seen.reshape(sums.shape)
            histories.seen[:] = 0
        count = histories.followed // _ROUNDS
        excess = (_relative_error(rounds) / precision) ** 2 - 1
        missing = 0 if wanted_histories is not None or excess < 0.1 else math.ceil(count * min(excess, 15.0))
    return rounds, histories.followed


def _relative_error(rounds: Floats) -> float:
    """Return the standard deviation of the mean of the rounds' totals, as a share of it; 0 if nothing is in them."""
    totals = rounds.sum(axis=(1, 2, 3))
    return float(totals.std(ddof=1) / math.sqrt(_ROUNDS) / totals.mean()) if totals.any() else 0.0


def _pixel_shares(bins: int, pixels: int) -> Floats:
    """Return the matrix (pixels, bins) that makes pixels of the sums of bins along an axis, with the same totals.

    In each bin the density is the parabola that has the bin's sum, and at its ends the values of the cubics through the sums
    of the four nearest bins (P. Colella, P. R. Woodward, Journal of Computational Physics 54 (1984) 174).
    """
    until = np.vstack([np.zeros(bins), np.tri(bins)])
    means = np.pad(np.eye(bins), ((2, 2), (0, 0)), mode="reflect", reflect_type="odd") if bins > 1 else np.ones((5, 1))
    slopes = (7 * (means[1:-2] + means[2:-1]) - means[:-3] - means[3:]) / 12
    ends = np.linspace(0, bins, pixels + 1)
    first = np.minimum(ends.astype(int), bins - 1)
    t = (ends - first)[:, None]
    curve = until[first] + (3 - 2 * t) * t**2 * (until[first + 1] - until[first])
    curve += t * (1 - t) ** 2 * slopes[first] - t**2 * (1 - t) * slopes[first + 1]
    return np.diff(curve, axis=0)
