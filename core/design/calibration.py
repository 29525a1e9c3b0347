"""Calibration: where the modules of a scanner are, from images of point sources."""

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import ArrayLike, Bools, Floats, Indexes
from ..errors import InputError, several
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..models.emission import Emission
from ..models.model import with_image_axes
from ..progress import Progress, stages_of
from ..runs.display import DIVERGING, Display
from ..runs.mosaic import Sheet, sheet
from ..validation import instance, one_of, positive, real_array, shape_text
from .bundle import LENGTH, OFFSET, Bundle, Moved
from .point_images import Lattice
from .solvers import scipy_module
from .spots import Spots, find_spots

FITTED = (LENGTH, OFFSET)
"""What can be fitted besides places and tilts. A detector's roll is the module's tilt about k, as the hole is round."""
_NAMES = ("position u", "position v", "position k", "tilt u", "tilt v", "tilt k")
_FEWEST = 3  # points: a module has six numbers, and each point tells two
_UNLIKE = 5.0  # standard deviations that an image is less like a disc's than by chance
_OUTLYING = 6.0  # standard deviations from where the geometry has a spot
_FAR = 5.0  # standard deviations of what was thought of a module's numbers
_ROUNDS = 20
_CHANCE = 1e-3  # that any module of a right model is said not to fit
_STAYS = 1e-6  # mm, degrees: rounding
_TOLD = 0.75  # of a number's variance that images must take away
_MOST = 5.0  # standard deviations at the ends of the colours of residuals


@dataclass(frozen=True, eq=False)
class Calibration:
    """A scanner as images of point sources have it, by `calibrate`.

    Attributes
    ----------
    system : PinholeSystem
        The modules at their places with their tilts, and with their lengths if these were fitted.
    nominal : PinholeSystem
        The geometry that was given.
    views : Views
        Theirs: the given ones moved with the modules, and their pixels by the detectors' offset.
    points : array (K, 3)
        The sources, world mm.
    covariance : array (M, 6, 6)
        Of each module: of the pinhole's position along the module's own u, v and k, mm, then of the tilt's rotation vector
        (``system.tilt``), rad.
    chi_square : array (M,)
        Pearson's, per degree of freedom, of the pixels around the spots, with the spots where the geometry has them: about 1
        if the model is right. NaN where nothing was seen.
    misfit : array (M,)
        Squared distances of spots from where the geometry has them, in units of their variance, per degree of freedom.
    misfitting : tuple of int
        Numbers of the modules that do not fit. Their outlying images were left out; those of a module that they would put
        farther than 5 standard deviations from its nominal place, all, and it has stayed there.
    used : array (K, M)
        The images that were used.
    names : tuple of str
        The P numbers that were fitted for each module.
    spread : array (M, P)
        Their standard deviations, mm and rad.
    told : array (M, P)
        Share of each number's variance, as it was thought before, that the images take away: one with 0 has stayed nominal.
    gauge : tuple of str
        What images cannot tell of the scanner as a whole: "shift", "turn" and, of unknown scale, "scale": 7 numbers, or 6,
        or none with known points. By these the pinholes are on average where they nominally are.
    detector_offset : array (M, 2)
        How far pixels lie from where the given views have them, mm along u and v on the crystal.
    residuals : array (M, n_v, n_u)
        Of each module's spots together, the counts around them less those expected, in standard deviations.
    """

    system: PinholeSystem
    nominal: PinholeSystem
    views: Views
    points: Floats
    covariance: Floats
    chi_square: Floats
    misfit: Floats
    misfitting: tuple[int, ...]
    used: Bools
    names: tuple[str, ...]
    spread: Floats
    told: Floats
    gauge: tuple[str, ...]
    detector_offset: Floats
    residuals: Floats

    def untold(self) -> list[str]:
        """What the images hardly tell, and so has stayed about nominal: lines such as "modules 3, 17: length"."""
        weak: dict[str, list[str]] = {}
        for name, told in zip(self.names, self.told.T, strict=True):
            numbers = self.system.numbers[told < _TOLD].tolist()
            if numbers:
                some = f"module{'s' * (len(numbers) > 1)} {several(numbers, 12)}"
                weak.setdefault("all modules" if len(numbers) == len(told) else some, []).append(name)
        return [f"{which}: {', '.join(names)}" for which, names in weak.items()]

    def residual_sheet(self) -> Sheet:
        """The residuals of all modules, drawn ring by ring: noise without a pattern where the geometry fits."""
        display = Display(colors=DIVERGING, low=-_MOST, high=_MOST)
        residuals = self.residuals.astype(np.float32)
        return sheet(residuals, self.system.numbers, self.system.rings(), "standard deviations", display)

    def summary(self) -> list[str]:
        """How far modules are from their nominal places and tilts, what does not fit and what is not told, in lines."""
        shifts = np.linalg.norm(self.system.centers - self.nominal.centers, axis=1)
        turns = np.degrees(np.linalg.norm(self.system.tilt - self.nominal.tilt, axis=1))
        moved, worst = int(((shifts > _STAYS) | (turns > _STAYS)).sum()), int(np.argmax(shifts))
        mm, degrees = (np.sqrt((each**2).sum() / max(1, moved)) for each in (shifts, turns))
        odd, whole = several(self.misfitting, 12), ", ".join(self.gauge)
        return [
            f"{moved} of {len(shifts)} modules moved, RMS {mm:.2f} mm and {degrees:.2f} degrees",
            f"farthest: module {self.system.numbers[worst]}, {shifts[worst]:.2f} mm and {turns[worst]:.2f} degrees",
            f"modules that do not fit: {odd}" if odd else "all modules fit",
            *([f"{whole} of the scanner as a whole: nominal, these images do not tell them"] if whole else []),
            *(f"not told, {line}" for line in self.untold()),
        ]


def calibrate(
    system: PinholeSystem,
    images: ArrayLike,
    views: Views,
    points: ArrayLike | None = None,
    distances: ArrayLike | None = None,
    *,
    model: Emission | None = None,
    fit: Collection[str] = (),
    position_sd: float = 5.0,
    tilt_sd_degrees: float = 2.0,
    collimator_length_sd: float = 1.0,
    detector_offset_sd: float = 0.5,
    distance_sd: float = 0.02,
    progress: Progress | None = None,
) -> Calibration:
    """Find where a scanner's modules are from images of point sources, one source in each of K acquisitions.

    In each image the spot's middle is that of the largest Poisson likelihood of the whole hole's shadow, in closed form; its
    counts, its radius and an even background are free, so neither activities nor diameters of holes need be known. Modules
    and points are those of the least squares of all middles (SciPy). Images that do not fit are left out, and their modules
    named.

    Parameters
    ----------
    system
        The nominal geometry.
    images
        (K, M, n_v, n_u): measured counts of each acquisition.
    views
        The nominal views of the images.
    points
        (K, 3): where the sources are, world mm. None: they are found, too.
    distances
        (K, K): those between sources that are known, mm, NaN elsewhere; they give the scale. None: it stays nominal.
    model
        The physics: holes, the crystal's blur, background. None: a crystal without blur, whose sharp shadows make the
        covariances too small for one with it.
    fit
        What is fitted besides places and tilts, of "collimator_length" and "detector_offset".
    position_sd, tilt_sd_degrees, collimator_length_sd, detector_offset_sd
        How far modules may be from the nominal geometry along each axis: standard deviations, mm and degrees. They are weak
        beside what images tell; what these do not tell stays nominal.
    distance_sd
        How well the distances are known, mm.
    progress
        Counts acquisitions.

    Raises
    ------
    InputError
        There are too few points, an acquisition shows none, images and views are not of the system, most modules are farther
        away than allowed, or SciPy is missing.
    """
    instance(system, PinholeSystem, "calibrate: system")
    instance(views, Views, "calibrate: views")
    model = Emission(system) if model is None else model
    _check_model(model, system, views)
    images = real_array(images, "calibrate: images", (None, len(system), *views.shape))
    n_k = len(images)
    if images.min(initial=0.0) < 0:
        raise InputError(f"calibrate: images: expected counts, 0 or more, got {images.min():g}")
    if n_k < _FEWEST:
        raise InputError(f"calibrate: images: expected {_FEWEST} acquisitions or more, each of a point, got {n_k}")
    for name in fit:
        one_of(name, FITTED, "calibrate: fit")
    own = {LENGTH: [collimator_length_sd], OFFSET: [detector_offset_sd] * 2}
    fitted = tuple(name for name in FITTED if name in fit)
    sd = [position_sd] * 3 + [math.radians(tilt_sd_degrees)] * 3 + [each for name in fitted for each in own[name]]
    sds = np.array([positive(each, "calibrate: standard deviations") for each in sd])
    pairs, lengths = _known_distances(distances, n_k)
    if points is not None and len(pairs):
        raise InputError("calibrate: give points or distances, not both")
    lattice = Lattice.of(model, views)
    radii = model.effective_diameter / 2 * (1 + system.collimator_length / system.pinhole_distance)
    stages = stages_of(progress)
    spots = find_spots(images, with_image_axes(model.background), lattice, radii, stages("finding spots"))
    stages("finding modules")
    _require_spots(spots.seen, 2 if points is None else 1)
    places = lattice.first + lattice.step * spots.pixels
    covariance = spots.covariance * lattice.step[:, :, None] * lattice.step[:, None, :]
    pearson, freedom = spots.pearson(lattice)
    unlike = pearson / np.maximum(freedom, 1)  # a disc's image: then the middle is known less well
    covariance *= np.where(unlike > 1 + _UNLIKE * np.sqrt(2 / np.maximum(freedom, 1)), unlike, 1.0)[..., None, None]
    covariance[~spots.seen], places[~spots.seen] = np.eye(2), 0.0
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    start = _triangulated(system, places, spots.seen) if points is None else points
    start = real_array(start, "calibrate: points", (n_k, 3))
    of_places = places, whitening, spots.seen, pairs, lengths, positive(distance_sd, "calibrate: distance_sd", "mm")
    bundle, x = _without_outliers(Bundle(system, start, points is None, fitted, sds, *of_places))
    return _result(views, bundle, x, spots, lattice)


def _check_model(model: Emission, system: PinholeSystem, views: Views) -> None:
    instance(model, Emission, "calibrate: model")
    if len(model.system) != len(system) or not np.allclose(model.system.poses(), system.poses()):
        raise InputError("calibrate: model: expected that of the system, Emission(system, ...)")
    model.check(views)
    uneven = np.ndim(model.efficiency) == 3 or not np.all(model.efficiency)
    others = {"edge 'path'": model.edge == "path", "depth_layers": model.depth_layers > 1}
    others |= {"wall_thickness": model.wall_thickness is not None}
    others |= {"lines apart": model.is_apart, "efficiency of single pixels, or of 0": uneven}
    for name, is_other in others.items():
        if is_other:
            raise InputError(f"calibrate: model: takes no {name}: a spot is a hole's shadow on the crystal's front")


def _known_distances(distances: ArrayLike | None, n_k: int) -> tuple[Indexes, Floats]:
    """Pairs (D, 2) of points whose distances (D,), mm, are known."""
    table = np.full((n_k, n_k), np.nan) if distances is None else np.array(distances, np.float64)
    if table.shape != (n_k, n_k):
        raise InputError(f"calibrate: distances: expected shape {n_k} x {n_k}, got {shape_text(table.shape)}")
    table = np.where(np.isnan(table), table.T, table)
    pairs = np.argwhere(np.triu(~np.isnan(table), 1))
    lengths = table[tuple(pairs.T)]
    if not np.array_equal(table, table.T, equal_nan=True) or not (np.isfinite(lengths) & (lengths > 0)).all():
        expected = "lengths above 0 mm, the same from j to i as from i to j, or NaN"
        raise InputError(f"calibrate: distances: expected {expected}")
    return pairs, lengths


def _require_spots(seen: Bools, modules: int) -> None:
    for k in np.flatnonzero(seen.sum(axis=1) < modules)[:1]:
        found = f"acquisition {k + 1}: {seen[k].sum()} modules see a point source"
        raise InputError(f"calibrate: images: {found}, expected {modules} or more")
    if seen.sum(axis=0).max() < _FEWEST:
        found = f"no module sees {_FEWEST} points"
        raise InputError(f"calibrate: images: {found}; expected more of them in its field of view")


def _triangulated(system: PinholeSystem, places: Floats, seen: Bools) -> Floats:
    """Points (K, 3) nearest to the nominal rays; those far from the others count little."""
    local = np.concatenate([places, np.broadcast_to(system.collimator_length[:, None], (*seen.shape, 1))], axis=2)
    rays = np.einsum("mij,kmi->kmj", system.frames(), local / np.linalg.norm(local, axis=2, keepdims=True))
    across = np.eye(3) - rays[..., None] * rays[..., None, :]
    weights = seen.astype(np.float64)
    for _ in range(10):
        weighted = weights[..., None, None] * across
        right = np.einsum("kmij,mj->ki", weighted, system.centers)
        points = np.linalg.solve(weighted.sum(axis=1) + 1e-9 * np.eye(3), right[..., None])[..., 0]
        off = np.einsum("kmij,kmj->kmi", across, points[:, None] - system.centers)
        weights = seen / (1 + np.linalg.norm(off, axis=2))
    return points


def _without_outliers(bundle: Bundle) -> tuple[Bundle, Floats]:
    """The bundle without the images that do not fit, and its solution."""
    x, robust = bundle.start(), True
    for _ in range(_ROUNDS):
        x, used = bundle.solved(x, robust), bundle.used
        off = used * bundle.off(x)
        usual = max(1.0, float(np.median(off[used])) / math.sqrt(2 * math.log(2)))  # the median of two normal numbers
        # They would be another module's images, or upside down.
        bad = used & (np.abs(bundle.of_modules(x)) > _FAR).any(axis=1)
        if not bad.any():  # the worst only: they draw others away
            bad = off > max(_OUTLYING * usual, float(off.max()) / 2)
            bad |= used & bad.any(axis=0) & ((used & ~bad).sum(axis=0) <= _FEWEST)  # which anything fits
        if not bad.any() and not robust:
            break
        robust = bool(bad.any())
        bundle = replace(bundle, used=used & ~bad)
        if bundle.used.any(axis=0).sum() < len(bundle.system) / 2:
            raise InputError(
                "calibrate: most modules would be farther than 5 standard deviations from the nominal geometry; expected "
                "points in the scanner's frame (or their distances instead), or larger position_sd and tilt_sd_degrees"
            )
        bundle.of_modules(x)[bad.any(axis=0)] = 0.0
    return bundle, x


def _result(views: Views, bundle: Bundle, x: Floats, spots: Spots, lattice: Lattice) -> Calibration:
    nominal, now, seen, used = bundle.system, bundle.moved(x), spots.seen, bundle.used
    covariance, leverages = bundle.covariance(x)
    told = np.clip(1 - np.diagonal(covariance, axis1=1, axis2=2), 0, 1)
    units = np.broadcast_to(np.eye(len(bundle.sd)) * bundle.sd, covariance.shape).copy()
    # Shifts along the module's own axes.
    units[:, :3, :3] = now.frames @ nominal.frames().swapaxes(1, 2) * bundle.sd[:3]
    covariance = units @ covariance @ units.swapaxes(1, 2)
    off, (pearson, freedom) = bundle.off(x) ** 2, spots.pearson(lattice)
    of_middles, of_pixels = (2 * used - leverages).sum(axis=0), (seen * (freedom + 2) - leverages).sum(axis=0)
    sums = ((used * off).sum(axis=0), of_middles), ((seen * (pearson + off)).sum(axis=0), of_pixels)
    misfit, chi_square = (np.where(of > 0.5, total / np.maximum(of, 0.5), np.nan) for total, of in sums)
    odd = (seen & ~used).any(axis=0) | _improbable(misfit, of_middles) | _improbable(chi_square, of_pixels)
    expected = spots.expected(lattice, (now.seen() - lattice.first) / lattice.step)
    over, total = ((seen[..., None, None] * each).sum(axis=0) for each in (spots.windows - expected, expected))
    extras = {LENGTH: ("length",), OFFSET: ("offset u", "offset v")}
    names = (*_NAMES, *(name for kind in bundle.fit for name in extras[kind]))
    gauge = ("shift", "turn", "scale")[: len(bundle.gauge()) // 3 + len(bundle.gauge()) % 3]
    return Calibration(
        nominal.replace(centers=now.centers, tilt=now.tilt, collimator_length=now.length), nominal,
        _moved_views(views, nominal, now), now.points, covariance[:, :6, :6], chi_square, misfit,
        tuple(nominal.numbers[odd].tolist()), used, names,
        np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), told, gauge, now.offset, over / np.sqrt(np.maximum(total, 1)),
    )  # fmt: skip


def _improbable(per_freedom: Floats, freedom: Floats) -> Bools:
    """Which modules' sums of squares are too large, beside those of the others, to be chance."""
    usual = max(1.0, float(np.nanmedian(per_freedom))) if np.isfinite(per_freedom).any() else 1.0
    values = np.nan_to_num(per_freedom) / usual
    chance = scipy_module("special").chdtrc(np.maximum(freedom, 0.5), values * freedom)
    return np.asarray(chance < _CHANCE / len(freedom))


def _moved_views(views: Views, nominal: PinholeSystem, now: Moved) -> Views:
    """The views, moved with the modules; pixels keep their places on the crystals but for the detectors' offsets."""
    frames, back = nominal.frames(), now.frames.swapaxes(1, 2)
    middle, u_steps, v_steps = (
        np.einsum("mij,mj->mi", frames, each)
        for each in (views.detector_centers - views.sources, views.u_steps, views.v_steps)
    )
    middle[:, :2] -= (middle[:, 2] / nominal.collimator_length)[:, None] * now.offset
    middle[:, 2] *= now.length / nominal.collimator_length
    middle, u_steps, v_steps = (np.einsum("mij,mj->mi", back, each) for each in (middle, u_steps, v_steps))
    return Views(now.centers, now.centers + middle, u_steps, v_steps, views.shape)
