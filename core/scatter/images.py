"""Images of photons that were scattered in a body, by Monte Carlo up to the modules and by the projector through them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from time import perf_counter
from typing import Any

import numpy as np

from ..arrays import Array, Floats, Floats32
from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..memory import require
from ..models.emission import Emission
from ..models.photon_lines import mu_volumes
from ..physics.energy_window import acceptance
from ..physics.isotopes import Window
from ..physics.mass_attenuation import HIGHEST_ENERGY
from ..physics.materials import APERTURES, CRYSTALS, attenuation, module_coefficients
from ..progress import Progress, part_of, stages_of
from ..projector.operator import Projector
from ..rays.parallel import in_order, thread_count
from ..rays.ray_geometry import view_rays
from ..recording import recorded_warnings
from ..validation import freeze, instance, positive, real_array, seed_number, strict_whole
from ..volumes.volume import Volume, require_quantity
from .body import LOWEST_ENERGY, Body
from .histories import Histories, PhotonSource

_ENERGIES = 512  # of the tables
_LEAST_SHARE = 1e-4  # of the photons of an energy that a window counts: below it they are not followed
_CELL, _MOST_CELLS = 5.0, 150_000  # least side, mm, and number of the cells whose collisions a module sees as one
_PARTS, _ROUNDS = 4, 32  # parts by whose differences deviations are known, and rounds of each for those of totals
_PILOT = 8192  # histories of the trial
_TOGETHER = 8  # modules whose emissions are copied at once
_LEAST = 8.0  # contributions below so many times the mean of a history are seen at random


@dataclass(frozen=True, eq=False)
class ScatterImages:
    """Images of scattered photons, with what is known of their accuracy."""

    images: Floats32
    """Expected counts (W, M, n_v, n_u) of scattered photons in each window, module and pixel."""
    deviation: Floats32
    """Standard deviations (W, M, n_v, n_u) of `images`, from parts of the histories, smoothed over 5 x 5 pixels."""
    windows: tuple[Window, ...]
    """Energy windows, keV."""
    precision: Floats
    """Standard deviations (W, M) of the modules' totals, as shares of them; 0 where nothing is counted."""
    histories: int
    """Number of photons that were followed."""
    by_order: Floats32 | None = None
    """Images (orders, W, M, n_v, n_u) of photons by their number of collisions, the last with all further ones; or None."""
    energies: Floats | None = None
    """Energies (n,), keV, of `spectra`; or None."""
    spectra: Floats | None = None
    """Scattered photons (M, n) that reach the crystal's side through the hole's effective area, by energy; or None."""


def scatter_images(
    activity: Volume,
    body: Volume,
    views: Views,
    model: Emission,
    *,
    windows: Sequence[Window] | None = None,
    histories: int | None = None,
    precision: float = 0.005,
    orders: int = 1,
    spectra: bool = False,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | None = None,
) -> ScatterImages:
    """Compute the images of photons that are scattered in a body before they pass a module's hole.

    Photons of all lines of the model's isotope begin where the activity is, and are followed through the voxels of the body:
    Compton scattering by Klein and Nishina's law and the incoherent scattering function, Rayleigh scattering by form
    factors, absorption by weight. At each collision the chance that the photon is scattered into a module's hole, and what
    remains of it on the way there at its new energy, are added to an emission that the module would see alike; the
    projector makes the image of that emission, with the model's hole, crystal, blur and efficiencies. So one history
    serves all modules. Photons that are not scattered are the projector's alone.

    Aperture and crystal stop photons as at their own energy where the model has the materials' names; numbers hold for all
    energies. Photons that are scattered in apertures, walls and crystals are not simulated, nor those through walls.

    Parameters
    ----------
    activity : Volume
        Activity, kBq/mL, at the model's reference time.
    body : Volume
        CT numbers ("hu"), or attenuation coefficients ("mu", 1/mm) at the strongest line in the model's window, on any
        grid. The body consists of what `hu_to_mu` mixes: water of any density up to its own, and bone.
    views : Views
        The model's views.
    model : Emission
        Model of the counts, with an isotope and `energy_fwhm`. Its mu and background do not matter.
    windows : sequence of (low, high), optional
        Energy windows, keV, which the same histories fill. None: the model's.
    histories : int, optional
        Number of histories. None: as many as `precision` takes.
    precision : float
        Relative standard deviation of each module's total in the first window, up to which histories go on.
    orders : int
        Number of orders of scattering whose images are kept apart; the last has all from it on.
    spectra : bool
        Whether to return the spectra of the photons that reach the crystals, from 30 keV on.
    seed : int
        Seed of the random numbers: the same gives the same images, whatever the number of threads.
    threads : int, optional
        Number of threads, by default one per core.
    progress : callable, optional
        Called as ``progress(done, total)``, for a trial and again for the histories; may raise `Cancelled`. A
        `StagedProgress` is told their number and the seconds that they take.

    Returns
    -------
    ScatterImages
        Images (W, M, n_v, n_u) in counts, their standard deviations, spectra.

    Raises
    ------
    InputError
        The model has no isotope or no energy resolution, a volume holds another quantity or values below 0, a window is
        not two ascending energies, or all lines are below 30 keV or one is beyond the tables.

    References
    ----------
    F. J. Beekman, H. W. A. M. de Jong, S. van Geloven, "Efficient fully 3-D iterative SPECT reconstruction with Monte
    Carlo-based scatter compensation", IEEE Transactions on Medical Imaging 21 (2002) 867-877. S. Liu, M. A. King, A. B.
    Brill, M. G. Stabin, T. H. Farncombe, "Accelerated SPECT Monte Carlo simulation using multiple projection sampling and
    convolution-based forced detection", IEEE Transactions on Nuclear Science 55 (2008) 560-567.
    """
    instance(activity, Volume, "scatter: activity")
    instance(body, Volume, "scatter: body")
    instance(model, Emission, "scatter: model")
    require_quantity(activity.quantity, ("activity",), "scatter: activity")
    if model.isotope is None:
        raise InputError("scatter: the model has no isotope, whose photons have energies: give isotope='Tc-99m'")
    if model.energy_fwhm is None:
        raise InputError(
            "scatter: the model has no energy resolution: give energy_fwhm, such as 0.1 for NaI, 0.05 for CZT"
        )
    model.check(views)
    chosen = tuple(_checked_window(window) for window in windows or (model.window,))
    run = _Run(activity, body, views, model, chosen, orders, spectra, seed_number(seed), thread_count(threads))
    if histories is not None:
        count = strict_whole(histories, "scatter: histories", "1 or more")
        run.follow(count, progress)
    else:
        run.follow_until(positive(precision, "scatter: precision"), progress)
    return run.result()


def scattering_body(model: Emission) -> Volume:
    """Return a model's attenuation as the body of `scatter_images`; raise `InputError` if the model has none."""
    instance(model, Emission, "scatter: model")
    volumes: Sequence[Volume] = mu_volumes(model.mu)  # type: ignore[arg-type]  # in a model a tuple, not any sequence
    if not volumes:
        raise InputError(
            "scatter: the model has no attenuation, in which photons scatter: give mu (--mu FILE, --phantom-mu)"
        )
    energies = [energy for energy, _ in model.photon_lines]
    return volumes[0] if len(volumes) == 1 else volumes[energies.index(strongest_line(model))]


def strongest_line(model: Emission) -> float:
    """Return the energy, keV, of the strongest line in the window of a model with an isotope."""
    isotope: Any = model.isotope
    window: Any = model.window
    energy, _ = max(isotope.lines_within(*window), key=lambda line: line[1])
    return float(energy)


def _checked_window(window: Any) -> Window:
    """Return a window as two numbers; raise `InputError` unless they are ascending energies."""
    low, high = real_array(window, "scatter: window", (2,)).tolist()
    if not 0 <= low < high:
        raise InputError(f"scatter: window: expected two ascending energies, keV, got {low:g} and {high:g}")
    return low, high


class _Run:
    """A simulation of the images of scattered photons; see `scatter_images`."""

    def __init__(
        self,
        activity: Volume,
        body: Volume,
        views: Views,
        model: Emission,
        windows: tuple[Window, ...],
        orders: int,
        spectra: bool,
        seed: int,
        threads: int,
    ) -> None:
        self._views, self._model, self._windows, self._threads = views, model, windows, threads
        isotope: Any = model.isotope
        lines = [line for line in (*isotope.lines, *isotope.weak_lines) if line[0] > LOWEST_ENERGY]
        if not lines:
            raise InputError(f"scatter: expected photons above {LOWEST_ENERGY:g} keV; {isotope.name} has none")
        self._reference = strongest_line(model)
        self._body, self._source = Body.of(body, self._reference), PhotonSource.of(activity, lines)
        self._energies = self._table_energies(max(energy for energy, _ in lines), spectra)
        cell_of, self._cells = _cells(self._body.grid)
        self._modules = _modules(views, model, float(np.linalg.norm(self._cells.spacing)))
        orders = strict_whole(orders, "scatter: orders", "1 or more")
        numbers = orders * len(windows) * len(views) * (self._cells.n_voxels + 3 * math.prod(views.shape))
        require(4.0 * numbers, f"scatter into {len(windows)} windows of {len(views)} modules")
        self._histories = Histories(
            self._body, self._source, self._modules, self._energies, self._accepted(),
            cell_of, self._cells.n_voxels, orders, seed, threads, spectra,
        )  # fmt: skip
        self._rounds: list[Floats] = []  # totals (W, M) of each round, per history
        self._counts: list[int] = []  # histories of each round
        shape = (orders, len(windows), len(views), *views.shape)
        self._mean, self._squares = np.zeros(shape, np.float32), np.zeros(shape[1:], np.float32)
        self._parts, self._count = 0, 0  # numbers of parts and of their histories
        self._projectors = [self._projector(m) for m in range(len(views))]

    def follow_until(self, precision: float, progress: Progress | None) -> None:
        """Run histories until all modules' totals in the first window are known to a relative `precision`."""
        stages, start = stages_of(progress), perf_counter()
        self._follow_rounds(_PILOT, stages("trying scatter"))
        seconds = (perf_counter() - start) / self._histories.followed
        self._modules["least"] = _LEAST * np.max(np.mean(self._rounds, axis=0), axis=0)
        needed = self._needed(precision)
        self._histories.seen[:], self._rounds, self._counts = 0, [], []
        followed = stages(f"scattering {needed} photons, some {max(needed * seconds, 1):.0f} s")
        for k in range(
            _PARTS
        ):  # few rounds have too large a deviation among those of many modules: each part knows better
            if k == 0 or needed > self._count:
                self._follow_part((needed - self._count) / (_PARTS - k), part_of(followed, k, _PARTS))
                needed = self._needed(precision)
        if self._count < 0.9 * needed:
            self._follow_part(needed - self._count, stages(f"scattering {needed - self._count} photons more"))

    def follow(self, count: int, progress: Progress | None) -> None:
        """Run at least `count` histories."""
        for k in range(_PARTS):
            self._follow_part(count / _PARTS, part_of(progress, k, _PARTS))

    def _needed(self, precision: float) -> int:
        """Return the number of histories that a precision takes, by those so far, of which there are at least `_PILOT`."""
        error = float(self._errors()[0].max(initial=0.0))
        return max(math.ceil(sum(self._counts) * min((error / precision) ** 2, 1e4)), _PILOT)

    def _errors(self) -> Floats:
        """Return the relative standard deviations (W, M) of the modules' totals, by the differences of rounds."""
        counts, rounds = np.array(self._counts, float), np.array(self._rounds)
        mean = np.average(rounds, axis=0, weights=counts)
        squares = np.average((rounds - mean) ** 2, axis=0, weights=counts)
        error = np.sqrt(squares / (len(rounds) - 1))
        return np.divide(error, mean, out=np.zeros_like(mean), where=mean > 0)

    def _follow_part(self, count: float, progress: Progress | None) -> None:
        """Run at least `count` histories, and add what is seen of them to the mean image and its variance.

        By D. H. D. West, Communications of the ACM 22 (1979) 532, with the histories of a part as its weight.
        """
        new = self._follow_rounds(count, progress)
        off = self._project(self._histories.seen) / new - self._mean
        self._histories.seen[:] = 0
        self._parts, self._count = self._parts + 1, self._count + new
        self._mean += off * (new / self._count)
        self._squares += off.sum(axis=0) ** 2 * (new * (1 - new / self._count))

    def _follow_rounds(self, count: float, progress: Progress | None) -> int:
        """Run rounds of at least `count` histories together, keep their totals, and return the number of histories."""
        each = math.ceil(count / _ROUNDS)
        for k in range(_ROUNDS):
            self._histories.totals[:] = 0
            self._histories.run(each, part_of(progress, k, _ROUNDS))
            self._rounds.append(self._histories.totals / each)
            self._counts.append(each)
        return _ROUNDS * each

    def _project(self, weights: Array) -> Array:
        """Return the images (orders, W, M, n_v, n_u) of what the modules saw, for one history."""
        scale = np.float32(self._source.photons / self._cells.voxel_volume)
        images = np.empty(self._mean.shape, np.float32)

        def project(first: int) -> None:
            modules = range(first, min(first + _TOGETHER, len(self._views)))
            for order, window in np.ndindex(images.shape[:2]):
                emissions = np.ascontiguousarray(weights[order, window, :, modules.start : modules.stop].T)
                for m, emission in zip(modules, emissions.reshape(-1, *self._cells.shape), strict=True):
                    images[order, window, m] = self._projectors[m](emission)[0] * scale if emission.any() else 0

        for _ in in_order(project, range(0, len(self._views), _TOGETHER), self._threads):
            pass
        return images

    def result(self) -> ScatterImages:
        """Return the images, whose spectra are those of all histories."""
        variance = self._squares / ((self._parts - 1) * self._count)
        histories = self._histories.followed
        spectra = self._histories.spectra
        scale = self._source.photons / histories * np.broadcast_to(self._model.effective_time, len(self._views))
        return ScatterImages(
            images=freeze(self._mean.sum(axis=0)),
            deviation=freeze(np.sqrt(_smoothed(variance))),
            windows=self._windows,
            precision=freeze(self._errors()),
            histories=histories,
            by_order=freeze(self._mean) if len(self._mean) > 1 else None,
            energies=None if spectra is None else freeze(self._energies),
            spectra=None if spectra is None else freeze(spectra * scale[:, None]),
        )

    def _projector(self, m: int) -> Projector:
        """Return the projector of an emission that module m alone sees, one photon per decay, without attenuation."""
        model, optics = self._model, self._model.optics
        plain = replace(
            model, mu=None, isotope=None, window=None, energy_fwhm=None, lines="together", photons_per_decay=1.0,
            aperture_mu=optics.aperture_mu, crystal_mu=optics.crystal_mu, wall_thickness=None, background=0.0,
            time=model.effective_time, start=0.0,
        )  # fmt: skip
        module = np.array([m])
        with recorded_warnings():  # they are those of the model's own projector
            return Projector(self._cells, self._views[module], plain.of_views(module), threads=1)

    def _table_energies(self, highest: float, spectra: bool) -> Floats:
        """Return the energies, keV, of the tables: from the lowest that a window counts to the highest of the lines."""
        if highest > HIGHEST_ENERGY:
            expected = f"photons up to {HIGHEST_ENERGY:g} keV, of which there are tables"
            raise InputError(f"scatter: expected {expected}; the isotope has some of {highest:g} keV")
        energies = np.linspace(LOWEST_ENERGY, highest, 4 * _ENERGIES)
        shares = [max(self._share(energy, window) for window in self._windows) for energy in energies]
        counted = np.flatnonzero(np.array(shares) > _LEAST_SHARE)
        lowest = LOWEST_ENERGY if spectra else float(energies[counted[0]]) if len(counted) else highest - 1
        return np.linspace(min(lowest, highest - 1), highest, _ENERGIES)

    def _share(self, energy: float, window: Window) -> float:
        """Return the share of the photons of an energy, keV, that a window counts."""
        fwhm: Any = self._model.energy_fwhm
        return acceptance(energy, window, fwhm * math.sqrt(self._reference * energy))

    def _accepted(self) -> Floats32:
        """Return the shares (M, W, n) of photons that are counted, by those of the projector's hole and crystal."""
        shares = np.array([[self._share(energy, window) for energy in self._energies] for window in self._windows])
        return np.asarray(_optics_ratio(self._model, self._energies)[:, None] * shares, np.float32)


def _optics_ratio(model: Emission, energies: Floats) -> Floats:
    """Return the share of photons (M, n) that pass hole and crystal at these energies, by that at the model's lines.

    Coefficients that are a material's at the model's lines are that material's at other energies.
    """
    system, optics, lines = model.system, model.optics, model.photon_lines
    diameters = np.broadcast_to(system.pinhole_diameter, len(system))
    thickness = np.broadcast_to(system.detector_thickness, len(system))
    ratio = np.ones((len(system), len(energies)))
    if optics.aperture_mu is not None:
        for name in APERTURES:
            if module_coefficients(name, None, lines, system, optics.opening_angle)[0] == optics.aperture_mu:
                for i, energy in enumerate(energies):
                    optics_there = optics.with_numbers({"aperture_mu": attenuation(name, energy)})
                    ratio[:, i] *= (
                        optics_there.effective_diameter(diameters) / optics.effective_diameter(diameters)
                    ) ** 2
    if optics.crystal_mu is not None:
        usual = np.broadcast_to(optics.crystal_mu, len(system))
        mu_of = cache(lambda name: np.array([attenuation(name, energy) for energy in energies]))
        for m in range(len(system)):
            if name := system.crystal_material[m] or _crystal_of(model, float(usual[m])):
                ratio[m] *= np.expm1(-mu_of(name) * thickness[m]) / np.expm1(-usual[m] * thickness[m])
    return ratio


def _crystal_of(model: Emission, mu: float) -> str:
    """Return the crystal that has this coefficient at the model's lines; "" if none has."""
    arguments = model.photon_lines, model.system, model.optics.opening_angle
    names = (name for name in CRYSTALS if module_coefficients(None, name, *arguments)[1] == mu)
    return next(names, "")


def _cells(grid: Grid) -> tuple[Array, Grid]:
    """Return the numbers of the cells (n_x, n_y, n_z) of a grid's voxels, and the grid of the cells."""
    steps = np.maximum(np.round(_CELL / grid.spacing), 1).astype(int)
    while np.prod(shape := -(-np.array(grid.shape) // steps)) > _MOST_CELLS:
        steps[np.argmin(steps * grid.spacing)] += 1
    i, j, k = (np.arange(n) // step for n, step in zip(grid.shape, steps, strict=True))
    n_x, n_y, n_z = (int(n) for n in shape)
    numbers = np.asarray(np.ravel_multi_index(np.ix_(i, j, k), (n_x, n_y, n_z)))
    affine = grid.affine.copy()
    affine[:3, :3] *= steps
    affine[:3, 3] += grid.affine[:3, :3] @ ((steps - 1) / 2)
    return numbers, Grid((n_x, n_y, n_z), affine)


def _modules(views: Views, model: Emission, cell: float) -> Array:
    """Return the modules (M,) as the kernels take them; `cell` is the diagonal of a cell, mm."""
    from ..rays.backends.cpu import MODULE

    modules = np.zeros(len(views), MODULE)
    n_v, n_u = views.shape
    diameters = np.broadcast_to(model.effective_diameter, len(views))
    for m, (u, v, axis) in enumerate(model.system.frames()):
        fan = view_rays(views, m)
        ends = fan.corner - fan.source + np.array([
            (i * n_v - 0.5) * fan.row_step + (j * n_u - 0.5) * fan.column_step for i in (0, 1) for j in (0, 1)
        ])  # fmt: skip
        slopes_u, slopes_v = (ends @ side / (ends @ axis) for side in (u, v))
        spread = 1.5 * diameters[m] + 3 * np.max(model.intrinsic_fwhm)
        modules[m] = (
            views.sources[m], u, v, axis, (slopes_u.min(), slopes_u.max(), slopes_v.min(), slopes_v.max()),
            1.5 * diameters[m] + cell, spread / model.system.collimator_length[m], 0.0, diameters[m] ** 2 / 16, 0.0,
        )  # fmt: skip
    return modules


def _smoothed(variance: Array) -> Array:
    """Return variances (..., n_v, n_u) as means of the 5 x 5 pixels around each, those within the image."""
    for axis in (-2, -1):
        n = variance.shape[axis]
        near = (abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 2).astype(np.float32)
        variance = np.moveaxis(np.tensordot(near / near.sum(axis=1, keepdims=True), variance, (1, axis)), 0, axis)
    return variance
