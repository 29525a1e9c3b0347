"""Calibration: where the modules of a scanner are, from images of point sources."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Floats
from ..errors import InputError, several
from ..geometry.frames import affine_matrix, cross_matrix, module_frames, rotations, tilts
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..progress import Progress
from ..projector.emission import Emission
from ..validation import instance, one_of, positive, real_array, shape_text
from .bundle import Bundle, changed
from .point_images import Lattice, shadow_radii
from .solvers import scipy_module
from .spots import Spots, find_spots

FITTED = ("collimator_length", "detector_offset")
"""What can be fitted besides places and tilts. A detector's roll is the module's tilt about k: the hole is round."""
_NAMES = ("position u", "position v", "position k", "tilt u", "tilt v", "tilt k")
_EXTRAS = {"collimator_length": ("length",), "detector_offset": ("offset u", "offset v")}
_FEWEST = 3  # spots of a module, which has six numbers
_OUTLYING = 6.0  # standard deviations from where the geometry has a spot
_ROUNDS = 6
_CHANCE = 1e-3  # that any module of a right model is said not to fit
_TOLD = 0.75  # share of a number's variance that images must take away


@dataclass(frozen=True, eq=False)
class Calibration:
    """A scanner as images of point sources have it, by `calibrate`.

    Attributes
    ----------
    system : PinholeSystem
        The modules at their places with their tilts, and lengths if these were fitted.
    views : Views
        Theirs: the given ones moved with the modules, their pixels by the detectors' offset.
    points : array (K, 3)
        The sources, world mm.
    covariance : array (M, 6, 6)
        Of each module: of the pinhole's position along the module's own u, v and k, mm, then of ``system.tilt``, the tilt's
        rotation vector about the nominal u, v and k, rad. Places are those after `gauge` is removed.
    chi_square : array (M,)
        Pearson's, per degree of freedom, of the pixels around the spots where the geometry has them: 1 if the model is right.
    misfit : array (M,)
        Squared distances of spots from where the geometry has them, in units of their variance, per degree of freedom.
    misfitting : tuple of int
        Numbers of the modules that do not fit; their outlying images were left out.
    used : array (K, M)
        The images that were used.
    names : tuple of str
        The numbers that were fitted for each module, P of them.
    told : array (M, P)
        Which share of each number's variance the images take away from what was known before: a number with 0 has stayed
        at that of the workbook.
    gauge : tuple of str
        What images cannot tell of the scanner as a whole: "shift", "turn" and, of unknown scale, "scale". It is moved such
        that its pinholes are as close as possible to the nominal ones.
    detector_offset : array (M, 2)
        How far the pixels lie from where the given views have them, mm along u and v on the crystal.
    point_covariance : array (K, 3, 3)
        Of `points`, mm^2; 0 of known ones.
    spread : array (M, P)
        Standard deviations of all numbers in `names`, mm and rad.
    residuals : array (K, M, 2)
        Where spots are less where the geometry has them, mm on the crystal along -u and -v; NaN where there is no spot.
    spots : Spots
        The images around the spots, and what the geometry expects there.
    """

    system: PinholeSystem
    views: Views
    points: Floats
    covariance: Floats
    chi_square: Floats
    misfit: Floats
    misfitting: tuple[int, ...]
    used: NDArray[np.bool_]
    names: tuple[str, ...]
    told: Floats
    gauge: tuple[str, ...]
    detector_offset: Floats
    point_covariance: Floats
    spread: Floats
    residuals: Floats
    spots: Spots

    def untold(self) -> list[str]:
        """What the images hardly tell, one line for each kind of number, such as "length: modules 3, 17"."""
        lines = []
        for name, told in zip(self.names, self.told.T, strict=True):
            weak = self.system.numbers[told < _TOLD]
            if len(weak):
                lines.append(f"{name}: " + ("all modules" if len(weak) == len(told) else f"modules {several(weak, 12)}"))
        return lines

    def residual_images(self) -> Floats:
        """Of each module the counts around its spots less those expected, in standard deviations: (M, n, n)."""
        off, expected = (
            (self.used[..., None, None] * each).sum(axis=0)
            for each in (self.spots.windows - self.spots.expected, self.spots.expected)
        )
        return off / np.sqrt(np.maximum(expected, 1.0))


def calibrate(
    system: PinholeSystem,
    images: ArrayLike,
    views: Views,
    points: ArrayLike | None = None,
    distances: ArrayLike | None = None,
    *,
    model: Emission | None = None,
    fit: Sequence[str] = (),
    position_sd: float = 5.0,
    tilt_sd_degrees: float = 2.0,
    collimator_length_sd: float = 1.0,
    detector_offset_sd: float = 0.5,
    distance_sd: float = 0.02,
    progress: Progress | None = None,
) -> Calibration:
    """Find where a scanner's modules are from images of point sources, one source in each of K acquisitions.

    In each image the spot's middle is found by its largest Poisson likelihood; its counts, its radius and an even background
    are free, so neither activities nor the sizes of holes need be known. Modules and points are those of the least squares
    of all middles, by SciPy's solver; images that do not fit are left out, and their modules named.

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
        (K, K): those between the sources that are known, mm, NaN elsewhere. They give the scale. None: it is not known.
    model
        The physics: holes, the crystal's blur and sides, background. None: ideal holes, and a crystal without blur; then the
        covariances are those of sharp shadows, too small.
    fit
        What is fitted besides places and tilts, of `FITTED`.
    position_sd, tilt_sd_degrees, collimator_length_sd, detector_offset_sd
        How far modules may be from the nominal geometry along each axis (standard deviations, mm and degrees). What images
        do not tell stays there, as far as these weak priors are weaker than the images.
    distance_sd
        How well the distances are known, mm.
    progress
        Counts acquisitions.

    Raises
    ------
    InputError
        There are too few points, an acquisition shows none, the views are not of the system, or SciPy is missing.
    """
    instance(system, PinholeSystem, "calibrate: system")
    instance(views, Views, "calibrate: views")
    model = _checked_model(model, system, views)
    scipy_module("optimize")
    images = real_array(images, "calibrate: images", (None, len(system), *views.shape))
    if images.min(initial=0.0) < 0:
        raise InputError(f"calibrate: images: expected counts, 0 or more, got {images.min():g}")
    n_k = len(images)
    if n_k < _FEWEST:
        raise InputError(f"calibrate: images: expected {_FEWEST} acquisitions or more, each of a point, got {n_k}")
    for name in fit:
        one_of(name, FITTED, "calibrate: fit")
    known = None if points is None else real_array(points, "calibrate: points", (n_k, 3))
    pairs = _pairs(distances, n_k)
    if known is not None and len(pairs[0]):
        raise InputError("calibrate: give points or distances, not both")
    extras = [(collimator_length_sd, 1)] * ("collimator_length" in fit) + [(detector_offset_sd, 2)] * ("detector_offset" in fit)
    sd = [position_sd] * 3 + [math.radians(positive(tilt_sd_degrees, "tilt_sd_degrees"))] * 3
    sds = np.array([positive(each, "standard deviation") for each in sd + [value for value, n in extras for _ in range(n)]])
    lattice = Lattice.of(system, views)
    radii = shadow_radii(model, system.pinhole_distance[None])[0]
    spots = find_spots(images, model, lattice, radii, progress=progress)
    _require_spots(spots, system)
    step = lattice.step
    covariance = spots.covariance * step[:, :, None] * step[:, None, :]
    whitening = np.zeros_like(covariance)
    whitening[spots.seen] = np.linalg.inv(np.linalg.cholesky(covariance[spots.seen]))
    places = lattice.places(np.nan_to_num(spots.pixels))
    start = _triangulated(system, places, spots.seen) if known is None else known
    bundle = Bundle(
        system.centers, system.frames(), system.collimator_length, np.zeros((len(system), 2)), start, sds, known is None,
        "collimator_length" in fit, places, whitening, spots.seen, (*pairs, positive(distance_sd, "distance_sd", "mm")),
    )  # fmt: skip
    bundle, x = _without_outliers(bundle)
    return _result(system, views, model, lattice, bundle, x, spots, images)


def _checked_model(model: Emission | None, system: PinholeSystem, views: Views) -> Emission:
    model = Emission(system) if model is None else model
    instance(model, Emission, "calibrate: model")
    if len(model.system) != len(system) or np.abs(model.system.centers - system.centers).max() > 1e-6:
        raise InputError("calibrate: model: it is of another system; expected Emission(system, ...)")
    model.check(views)
    for name, is_other in (("edge 'path'", model.edge == "path"), ("depth_layers", model.depth_layers > 1)):
        if is_other:
            raise InputError(f"calibrate: model: takes no {name}; a spot is a round hole's shadow on the crystal's front")
    return model


def _pairs(distances: ArrayLike | None, n_k: int) -> tuple[NDArray[np.intp], Floats]:
    """Pairs (D, 2) of points whose distances (D,), mm, are known."""
    if distances is None:
        return np.zeros((0, 2), np.intp), np.zeros(0)
    table = np.array(distances, np.float64)
    if table.shape != (n_k, n_k):
        raise InputError(f"calibrate: distances: expected shape {n_k} x {n_k}, got {shape_text(table.shape)}")
    table = np.where(np.isnan(table), table.T, table)
    first, second = np.nonzero(np.triu(~np.isnan(table), 1))
    if not np.array_equal(table, table.T, equal_nan=True) or not (table[first, second] > 0).all() or not len(first):
        raise InputError("calibrate: distances: expected lengths above 0 mm, the same from i to j as from j to i, or NaN")
    return np.stack([first, second], axis=1), table[first, second]


def _require_spots(spots: Spots, system: PinholeSystem) -> None:
    views_of = spots.seen.sum(axis=1)
    if (views_of < 2).any():
        k = int(views_of.argmin())
        raise InputError(f"calibrate: images: acquisition {k + 1}: {views_of[k]} modules see a point source, expected 2 or more")
    if spots.seen.sum(axis=0).max() < _FEWEST:
        raise InputError(f"calibrate: images: no module sees {_FEWEST} points; expected more points within its view")


def _triangulated(system: PinholeSystem, places: Floats, seen: NDArray[np.bool_]) -> Floats:
    """Points (K, 3) nearest to the rays of the nominal geometry; rays far from those of the rest count little."""
    local = np.concatenate([places, np.broadcast_to(system.collimator_length[:, None], (*seen.shape, 1))], axis=2)
    rays = np.einsum("mij,kmi->kmj", system.frames(), local / np.linalg.norm(local, axis=2, keepdims=True))
    across = np.eye(3) - rays[..., None] * rays[..., None, :]
    weights = seen.astype(float)
    for _ in range(10):
        weighted = weights[..., None, None] * across
        right = np.einsum("kmij,mj->ki", weighted, system.centers)
        points = np.linalg.solve(weighted.sum(axis=1) + 1e-9 * np.eye(3), right[..., None])[..., 0]
        off = np.linalg.norm(np.einsum("kmij,kmj->kmi", across, points[:, None] - system.centers), axis=2)
        weights = seen / (1 + off)
    return points


def _without_outliers(bundle: Bundle) -> tuple[Bundle, Floats]:
    """The solution without the spots that do not fit, and the bundle without them."""
    seen = bundle.used
    x = bundle.solved(bundle.start(), robust=True)
    for _ in range(_ROUNDS):
        off = _distances_off(bundle, x)
        usual = max(1.0, float(np.median(off[seen])) / math.sqrt(2 * math.log(2)))  # of two normal numbers
        used = seen & (off <= _OUTLYING * usual)
        if np.array_equal(used, bundle.used) and bundle is not None and _ > 0:
            break
        bundle = replace(bundle, used=used)
        x = bundle.solved(x)
    return bundle, x


def _distances_off(bundle: Bundle, x: Floats) -> Floats:
    """Distances (K, M) of the spots from where the geometry has them, in standard deviations."""
    off = np.einsum("kmij,kmj->kmi", bundle.whitening, bundle.places - bundle.moved(x).seen())
    return np.linalg.norm(off, axis=2)


def _result(
    system: PinholeSystem, views: Views, model: Emission, lattice: Lattice, bundle: Bundle, x: Floats, spots: Spots, images: Floats
) -> Calibration:
    found = bundle.moved(x)
    covariance, leverages = bundle.covariance(x)
    n_m, n_p = len(system), len(bundle.sd)
    before = np.square(bundle.sd)
    told = np.clip(1 - np.diag(covariance)[: bundle.n_modules].reshape(n_m, n_p) / before, 0, 1)
    expected = find_spots(images, model, lattice, shadow_radii(model, system.pinhole_distance[None])[0], lattice.pixels(found.seen()))
    sums, numbers = expected.pearson()
    used, seen = bundle.used, spots.seen
    misfits = used * _distances_off(bundle, x) ** 2
    freedom = np.maximum((used * 2 - leverages).sum(axis=0), 1e-9)
    lost = used.any(axis=0)
    pixel_freedom = np.maximum((seen * (numbers - 2)).sum(axis=0) - leverages.sum(axis=0), 1.0)
    misfit, chi_square = (np.where(lost, each, np.nan) for each in (misfits.sum(axis=0) / freedom, (seen * sums).sum(axis=0) / pixel_freedom))
    odd = (seen & ~used).any(axis=0) | _improbable(misfit, freedom) | _improbable(chi_square, pixel_freedom)
    gauge = () if not bundle.fits_points else ("shift", "turn") if len(bundle.distances[0]) else ("shift", "turn", "scale")
    fitting = ~odd & lost
    aligned, centers_of = _aligned(found, system.centers, fitting if fitting.sum() > 2 else lost, gauge)
    covariance = centers_of @ covariance @ centers_of.T
    poses = affine_matrix(aligned.frames.swapaxes(1, 2), aligned.centers)
    calibrated = system.at_poses(poses, collimator_length=aligned.length)
    covariance = changed(covariance, _to_tilts(aligned, n_p))
    blocks = covariance[: bundle.n_modules, : bundle.n_modules].reshape(n_m, n_p, n_m, n_p)[np.arange(n_m), :, np.arange(n_m)]
    of_points = np.zeros((len(images), 3, 3))
    if bundle.fits_points:
        n = len(images)
        of_points = covariance[bundle.n_modules :, bundle.n_modules :].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
    names = _NAMES + (("length",) if bundle.fits_length else ()) + (("offset u", "offset v") if n_p - bundle.fits_length > 6 else ())
    residuals = np.where(seen[..., None], bundle.places - found.seen(), np.nan)
    return Calibration(
        calibrated, _moved_views(views, system, aligned), aligned.points, blocks[:, :6, :6], chi_square, misfit,
        tuple(system.numbers[odd].tolist()), used, names, told, gauge, -aligned.offset, of_points,
        np.sqrt(np.diagonal(blocks, axis1=1, axis2=2)), residuals, expected,
    )  # fmt: skip


def _improbable(per_freedom: Floats, freedom: Floats) -> NDArray[np.bool_]:
    """Which modules' sums of squares are too large beside the others' to be chance."""
    usual = max(1.0, float(np.nanmedian(per_freedom)))
    chance = scipy_module("special").chdtrc(freedom, np.nan_to_num(per_freedom) / usual * freedom)
    return np.asarray((freedom > 0.5) & (chance < _CHANCE / len(freedom)))


def _aligned(found: Bundle, nominal: Floats, which: NDArray[np.bool_], gauge: tuple[str, ...]) -> tuple[Bundle, Floats]:
    """Modules and points moved as a whole such that pinholes are close to the nominal ones, and what covariances follow by.

    The similarity is that of the least squares (Umeyama 1991); covariances lose what is along the gauge (S-transformation,
    Baarda 1973).
    """
    n_m, n_p = len(nominal), len(found.sd)
    size = n_m * n_p + 3 * len(found.points) * found.fits_points
    if not gauge:
        return found, np.eye(size)
    middle, goal = found.centers[which].mean(axis=0), nominal[which].mean(axis=0)
    apart, wanted = found.centers[which] - middle, nominal[which] - goal
    u, singular, vt = np.linalg.svd(wanted.T @ apart)
    signs = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    turn = (u * signs) @ vt
    scale = float((singular * signs).sum() / (apart**2).sum()) if "scale" in gauge else 1.0
    centers, points = (goal + scale * (places - middle) @ turn.T for places in (found.centers, found.points))
    moved = replace(found, centers=centers, frames=found.frames @ turn.T, points=points)
    ways = np.concatenate([
        np.stack([_way(moved, np.broadcast_to(axis, (n_m, 3)), np.zeros((n_m, 3)), np.broadcast_to(axis, points.shape)) for axis in np.eye(3)]),
        np.stack([_way(moved, np.cross(axis, centers), np.broadcast_to(axis, (n_m, 3)), np.cross(axis, points)) for axis in np.eye(3)]),
        _way(moved, centers, np.zeros((n_m, 3)), points)[None] if "scale" in gauge else np.zeros((0, size)),
    ]).T  # fmt: skip
    held = ways.copy()
    of_modules = held[: n_m * n_p].reshape(n_m, n_p, -1)
    of_modules[:, 3:], of_modules[~which], held[n_m * n_p :] = 0, 0, 0
    return moved, np.eye(size) - ways @ np.linalg.solve(held.T @ ways, held.T)


def _way(bundle: Bundle, shifts: Floats, turns: Floats, of_points: Floats) -> Floats:
    """All numbers' changes where pinholes are shifted by (M, 3), frames turned by (M, 3) and points shifted by (K, 3)."""
    own = [np.einsum("mij,mj->mi", bundle.frames, each) for each in (shifts, turns)]
    rest = np.zeros((len(shifts), len(bundle.sd) - 6))
    return np.concatenate([np.concatenate([*own, rest], axis=1).ravel(), of_points.ravel()])


def _to_tilts(bundle: Bundle, n_p: int) -> Floats:
    """Matrices (M, P, P) from shifts and turns of modules to shifts and changes of their tilt, by central differences."""
    step = 1e-5
    blocks = np.broadcast_to(np.eye(n_p), (len(bundle.centers), n_p, n_p)).copy()
    for i, changes in enumerate(step * np.eye(6)):
        ends = []
        for sign in (1, -1):
            centers = bundle.centers + sign * np.einsum("mij,i->mj", bundle.frames, changes[:3])
            turned = rotations(np.broadcast_to(sign * changes[3:], (len(centers), 3))).swapaxes(1, 2) @ bundle.frames
            ends.append(tilts(module_frames(centers), turned))
        blocks[:, 3:6, i] = (ends[0] - ends[1]) / (2 * step)
    return blocks


def _moved_views(views: Views, nominal: PinholeSystem, found: Bundle) -> Views:
    """The views, moved with the modules; pixels keep their places on the crystals but for the detectors' offsets."""
    into = found.frames.swapaxes(1, 2) @ nominal.frames()
    middle = np.einsum("mij,mj->mi", nominal.frames(), views.detector_centers - views.sources)
    scale = middle[:, 2] / nominal.collimator_length
    middle[:, :2] -= scale[:, None] * found.offset
    middle[:, 2] *= found.length / nominal.collimator_length
    u_steps, v_steps = (np.einsum("mij,mj->mi", into, steps) for steps in (views.u_steps, views.v_steps))
    centers = found.centers + np.einsum("mij,mi->mj", found.frames, middle)
    return Views(found.centers, centers, u_steps, v_steps, views.shape)
