"""Calibration of a scanner: the positions and tilts of its modules from images of point sources."""

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import ArrayLike, Bools, Floats, Indexes
from ..errors import InputError, several, warn
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..models.emission import Emission
from ..models.model import with_image_axes
from ..physics.energy_window import FWHM_PER_SIGMA
from ..progress import Progress, Stages, stages_of
from ..runs.display import DIVERGING, Display
from ..runs.mosaic import MosaicSheet, draw_sheet
from ..validation import instance, one_of, positive, real_array, shape_text
from .bundle import LENGTH, OFFSET, BundleAdjustment, FittedGeometry
from .calibration_checks import warn_of_fit, warn_of_inputs
from .point_images import SpotModel
from .solvers import scipy_module
from .spots import Spots, find_spots

FITTED = (LENGTH, OFFSET)
"""Parameters that can be fitted besides positions and tilts.

A detector's roll is the module's tilt about k, because the hole is round.
"""
_PARAMETERS = ("position u", "position v", "position k", "tilt u", "tilt v", "tilt k")
_MIN_POINTS = 3  # a module has six parameters, and each point gives two equations
_DISC_MISFIT = 5.0  # standard deviations by which an image may differ from a disc's more than by chance
_OUTLIER = 6.0  # standard deviations of an outlier from its fitted position
_MAX_PRIOR = 5.0  # prior standard deviations by which a module's parameters may differ from the nominal ones
_ROUNDS = 20
_MODULES_OF_CHECK = 20  # of the fit that checks known places and distances, at least
_MAX_SCALE = 0.02  # by which known lengths may differ from those that nominal modules see
_FAR = 5.0  # typical deviations by which a known place, length or scale may differ from what images tell
_SAME_MAGNIFICATION = 0.01
_SPOT_ROUNDS = 6  # searches for spots, each with better known blur and magnifications
_FALSE_ALARM = 1e-3  # probability that any module of a correct model is reported as misfitting
_UNMOVED = 1e-6  # mm and degrees; smaller changes are rounding
_DETERMINED = 0.75  # share of a parameter's prior variance that images must remove to determine it
_COLOR_RANGE = 5.0  # standard deviations at both ends of the colours of residuals


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of `calibrate`: the scanner's geometry as determined by images of point sources.

    Attributes
    ----------
    system : PinholeSystem
        System with the calibrated positions and tilts, and with the calibrated lengths if these were fitted.
    nominal : PinholeSystem
        System with the nominal geometry.
    views : Views
        Nominal views, moved with the modules, and with their pixels shifted by the detector offset.
    points : array (K, 3)
        Positions of the sources, world mm.
    covariance : array (M, 6, 6)
        Covariance of each module's pinhole position along its own u, v and k, mm, and of its tilt's rotation vector
        (``system.tilt``), rad.
    chi_square : array (M,)
        Pearson's chi-square per degree of freedom of the pixels around the spots, for spots at the positions of the fitted
        geometry: about 1 if the model is right; NaN for a module without a spot.
    misfit : array (M,)
        Mean squared distance of the spots from their positions in the fitted geometry, in units of their variance, per
        degree of freedom.
    misfitting : tuple of int
        Numbers of the modules that do not fit. Their outliers were not used. A module that its images would move by more
        than 5 prior standard deviations keeps its nominal parameters, and none of its images was used.
    used : array (K, M)
        Mask of the images that the fit used.
    names : tuple of str
        Names of the P parameters that were fitted for each module.
    spread : array (M, P)
        Standard deviations of the fitted parameters, mm and rad.
    told : array (M, P)
        Share of each parameter's prior variance that the images removed; a parameter with 0 has kept its nominal value.
    gauge : tuple of str
        Changes of the scanner as a whole that the images cannot determine: "shift", "turn" and, if the scale is unknown,
        "scale", together 7 numbers, or 6, or none with known points. In these, the pinholes agree with the nominal ones on
        average.
    detector_offset : array (M, 2)
        Shift of the pixels on the crystal from those of the nominal views, mm along u and v.
    residuals : array (M, n_v, n_u)
        Counts around each module's spots, summed over its spots, minus expected counts, in standard deviations.
    blur : array (M,)
        FWHM of the crystals' blur, mm, fitted with one factor for all modules.
    blur_sd : array (M,)
        Standard deviations of `blur`, mm.
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
    blur: Floats
    blur_sd: Floats

    def untold(self) -> list[str]:
        """Return lines with the parameters that the images hardly determine, such as "modules 3, 17: length"."""
        names_by_modules: dict[str, list[str]] = {}
        for name, told in zip(self.names, self.told.T, strict=True):
            if numbers := self.system.numbers[told < _DETERMINED].tolist():
                modules = f"module{'s' * (len(numbers) > 1)} {several(numbers, 12)}"
                modules = "all modules" if len(numbers) == len(told) else modules
                names_by_modules.setdefault(modules, []).append(name)
        return [f"{modules}: {', '.join(names)}" for modules, names in names_by_modules.items()]

    def residual_sheet(self) -> MosaicSheet:
        """Draw the residuals of all modules, ring by ring: noise without a pattern where the geometry fits."""
        display = Display(colors=DIVERGING, low=-_COLOR_RANGE, high=_COLOR_RANGE)
        residuals = self.residuals.astype(np.float32)
        return draw_sheet(residuals, self.system.numbers, self.system.rings(), "standard deviations", display)

    def summary(self) -> list[str]:
        """Return lines with the modules' changes, those that do not fit, and the parameters that are not determined."""
        shifts = np.linalg.norm(self.system.centers - self.nominal.centers, axis=1)
        tilts = np.degrees(np.linalg.norm(self.system.tilt - self.nominal.tilt, axis=1))
        n_moved, far = int(((shifts > _UNMOVED) | (tilts > _UNMOVED)).sum()), int(np.argmax(shifts))
        mm, degrees = (np.sqrt((changes**2).sum() / max(1, n_moved)) for changes in (shifts, tilts))
        misfitting, gauge = several(self.misfitting, 12), ", ".join(self.gauge)
        return [
            f"{n_moved} of {len(shifts)} modules moved, RMS {mm:.2f} mm and {degrees:.2f} degrees",
            f"farthest: module {self.system.numbers[far]}, {shifts[far]:.2f} mm and {tilts[far]:.2f} degrees",
            f"modules that do not fit: {misfitting}" if misfitting else "all modules fit",
            f"crystals' blur: FWHM {self.blur.mean():.3f} mm, known to {self.blur_sd.mean():.3f} mm",
            *([f"{gauge} of the scanner as a whole: nominal, these images do not determine them"] if gauge else []),
            *(f"not determined: {line}" for line in self.untold()),
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
    source_diameter: float = 0.0,
    progress: Progress | None = None,
) -> Calibration:
    """Determine the positions and tilts of a scanner's modules from images of point sources, one source per acquisition.

    In each of K acquisitions, the centre of each module's spot is found by maximum likelihood (Poisson), with the shadow of
    the hole in closed form. The spot's counts and radius and a uniform background are free, and so is a factor of all
    crystals' blur: neither activities nor hole diameters nor the blur need be known. Modules and points are the
    least-squares solution for all centres (SciPy). Images that do not fit are not used, and their modules are reported.

    Parameters
    ----------
    system
        Nominal geometry.
    images
        Measured counts (K, M, n_v, n_u) of each acquisition.
    views
        Nominal views of the images.
    points
        Positions (K, 3) of the sources, world mm. None: they are determined, too.
    distances
        Known distances (K, K) between sources, mm, NaN for unknown ones; they determine the scale. None: the scale stays
        nominal.
    model
        Emission model with the holes and their edge, the crystals with their depth of interaction (`depth_layers`), and the
        background. The fit of the blur starts from `intrinsic_fwhm`, of which modules keep their ratios, or from a pixel's
        width. None: ``Emission(system)``.
    fit
        Parameters that are fitted besides positions and tilts, of "collimator_length" and "detector_offset".
    position_sd, tilt_sd_degrees, collimator_length_sd, detector_offset_sd
        Prior standard deviations of the modules from the nominal geometry along each axis, mm and degrees. These priors are
        weak compared with images; a parameter that no image determines stays nominal.
    distance_sd
        Standard deviation of the known distances, mm.
    source_diameter
        Diameter of the sources, balls, mm; 1.29 times the side of cubes. 0: points.
    progress
        Called with (done, total) steps of each search for spots.

    Raises
    ------
    InputError
        There are too few points, an acquisition shows none, images and views are not of the system, most modules are farther
        from the nominal geometry than allowed, or SciPy is missing.

    Warns
    -----
    InputWarning
        Known places or distances are of another scale, or some are wrong (these are not used); images are no counts; spots
        are wider than holes and sources let expect; a crystal of more than 2 mm has no depth of interaction.
    """
    instance(system, PinholeSystem, "calibrate: system")
    instance(views, Views, "calibrate: views")
    model = Emission(system) if model is None else model
    _check_model(model, system, views)
    images = real_array(images, "calibrate: images", (None, len(system), *views.shape))
    n_k = len(images)
    if images.min(initial=0.0) < 0:
        raise InputError(f"calibrate: images: expected counts, 0 or more, got {images.min():g}")
    if n_k < _MIN_POINTS:
        raise InputError(f"calibrate: images: expected {_MIN_POINTS} acquisitions or more, each of a point, got {n_k}")
    for name in fit:
        one_of(name, FITTED, "calibrate: fit")
    further_sd = {LENGTH: [collimator_length_sd], OFFSET: [detector_offset_sd] * 2}
    further = tuple(name for name in FITTED if name in fit)
    sd = [position_sd] * 3 + [math.radians(tilt_sd_degrees)] * 3 + [x for name in further for x in further_sd[name]]
    prior_sd = np.array([positive(x, "calibrate: standard deviations") for x in sd])
    warn_of_inputs(model, images)
    pairs, lengths = _known_distances(distances, n_k)
    if points is not None and len(pairs):
        raise InputError("calibrate: give points or distances, not both")
    known_points = None if points is None else real_array(points, "calibrate: points", (n_k, 3))
    stages = stages_of(progress)
    spots, start = _find_spots(images, model, SpotModel.from_model(model, views, source_diameter), known_points, stages)
    stages("finding modules")
    covariance, positions = spots.covariance[..., :2, :2].copy(), spots.centers.copy()
    pearson, freedom = spots.pearson()
    # The centre of a spot that is not like a disc is less certain.
    ratio, limit = pearson / np.maximum(freedom, 1), 1 + _DISC_MISFIT * np.sqrt(2 / np.maximum(freedom, 1))
    covariance *= np.where(ratio > limit, ratio, 1.0)[..., None, None]
    covariance[~spots.seen], positions[~spots.seen] = np.eye(2), 0.0
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    length_sd = positive(distance_sd, "calibrate: distance_sd", "mm")
    measured = positions, whitening, spots.seen, pairs[:0], lengths[:0], length_sd
    bundle = BundleAdjustment(system, start, True, further, prior_sd, *measured)
    if points is not None or len(pairs):
        bundle = _with_known_sources(bundle, points is not None, pairs, lengths)
    spots = replace(spots, seen=bundle.used)
    bundle, x = _fit_without_outliers(bundle)
    return _make_result(views, bundle, x, spots)


def _find_spots(
    images: Floats, model: Emission, spot_model: SpotModel, points: Floats | None, stages: Stages
) -> tuple[Spots, Floats]:
    """Return the spots in `images` (K, M, n_v, n_u), and the points (K, 3), mm: known ones, or a start of their fit.

    The spots' widths depend on the blur and on the points' distances, so they are searched for several times.
    """
    system, spots = model.system, None
    magnification = np.tile(system.collimator_length / system.pinhole_distance, (len(images), 1))
    sigma = np.broadcast_to(model.optics.intrinsic_fwhm, len(system)) / FWHM_PER_SIGMA
    sigma = np.where(sigma > 0, sigma, np.abs(spot_model.lattice.step).mean())
    for _ in range(_SPOT_ROUNDS):
        background = with_image_axes(model.background)
        spots = find_spots(images, background, spot_model, sigma, magnification, spots, stages("finding spots"))
        _require_spots(spots.seen, 2 if points is None else 1)
        start = _triangulate_points(system, spots.centers, spots.seen) if points is None else points
        heights = np.einsum("mj,kmj->km", system.frames()[:, 2], start[:, None] - system.centers)
        fits_window, sigma = (spots.sigma < 1.2 * sigma).all(), spots.sigma
        magnification = system.collimator_length / np.maximum(heights, system.collimator_length)
        if fits_window and (np.abs(magnification - spots.magnification) < _SAME_MAGNIFICATION).all():
            break
    return spots, start  # type: ignore[return-value]  # after one round at least


def _check_model(model: Emission, system: PinholeSystem, views: Views) -> None:
    """Raise `InputError` unless the model is that of the system and of a hole's shadow."""
    instance(model, Emission, "calibrate: model")
    if len(model.system) != len(system) or not np.allclose(model.system.poses(), system.poses()):
        raise InputError("calibrate: model: expected that of the system, Emission(system, ...)")
    model.check(views)
    is_uneven = np.ndim(model.efficiency) == 3 or not np.all(model.efficiency)
    refused = {"wall_thickness": model.wall_thickness is not None, "lines apart": model.is_apart}
    refused["efficiency of single pixels, or of 0"] = is_uneven
    for name, is_refused in refused.items():
        if is_refused:
            raise InputError(f"calibrate: model: takes no {name}: a spot is a hole's shadow")


def _known_distances(distances: ArrayLike | None, n_k: int) -> tuple[Indexes, Floats]:
    """Return the pairs (D, 2) of points with a known distance, and these distances (D,), mm, of a table (K, K)."""
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


def _require_spots(seen: Bools, n_modules: int) -> None:
    """Raise `InputError` unless `n_modules` modules see each point and some module sees enough points; `seen` is (K, M)."""
    for k in np.flatnonzero(seen.sum(axis=1) < n_modules)[:1]:
        fault = f"acquisition {k + 1}: {seen[k].sum()} modules see a point source"
        raise InputError(f"calibrate: images: {fault}, expected {n_modules} or more")
    if seen.sum(axis=0).max() < _MIN_POINTS:
        fault = f"no module sees {_MIN_POINTS} points"
        raise InputError(f"calibrate: images: {fault}; expected more of them in its field of view")


def _triangulate_points(system: PinholeSystem, positions: Floats, seen: Bools) -> Floats:
    """Return the points (K, 3), world mm, closest to the nominal rays of their spots; outlying rays have little weight.

    `positions` (K, M, 2) are the spots on the crystals, mm; `seen` (K, M) tells which exist.
    """
    local = np.concatenate([positions, np.broadcast_to(system.collimator_length[:, None], (*seen.shape, 1))], axis=2)
    rays = np.einsum("mij,kmi->kmj", system.frames(), local / np.linalg.norm(local, axis=2, keepdims=True))
    projections = np.eye(3) - rays[..., None] * rays[..., None, :]  # perpendicular to the rays
    weights = seen.astype(np.float64)
    for _ in range(10):
        weighted = weights[..., None, None] * projections
        right = np.einsum("kmij,mj->ki", weighted, system.centers)
        points = np.linalg.solve(weighted.sum(axis=1) + 1e-9 * np.eye(3), right[..., None])[..., 0]
        distances = np.einsum("kmij,kmj->kmi", projections, points[:, None] - system.centers)
        weights = seen / (1 + np.linalg.norm(distances, axis=2))
    return points


def _with_known_sources(free: BundleAdjustment, are_points: bool, pairs: Indexes, lengths: Floats) -> BundleAdjustment:
    """Return the adjustment with the known `lengths` (D,), mm, of `pairs` (D, 2), or with its points as the known ones.

    Where two modules or more see each point, a fit of some modules without these tells whether they are of another scale,
    and are then not used, and which of four points or three lengths are wrong. These are left out. All of it is warned of.
    """
    bundle, points, n_k = replace(free, pairs=pairs, distances=lengths), free.points, len(free.points)
    groups, name = np.eye(len(pairs)) > 0, "distances"  # of lengths that are right or wrong together
    labels = [f"{i} to {j}" for i, j in pairs + 1]
    if are_points:
        bundle, pairs = replace(free, fits_points=False), np.argwhere(np.triu(np.ones((n_k, n_k)), 1))
        lengths = np.linalg.norm(np.diff(points[pairs], axis=1)[:, 0], axis=1)
        groups, name = (pairs == np.arange(n_k)[:, None, None]).any(axis=2), "points"
        labels = [str(k + 1) for k in range(n_k)]
    checked = slice(None, None, max(1, len(free.system) // _MODULES_OF_CHECK))
    trial = replace(free, system=free.system[checked], positions=free.positions[:, checked],
                    whitening=free.whitening[:, checked], used=free.used[:, checked])  # fmt: skip
    if trial.used.sum(axis=1).min() < 2:
        return bundle
    trial, x = _fit_without_outliers(trial)
    fitted = np.linalg.norm(np.diff(trial.geometry(x).points[pairs], axis=1)[:, 0], axis=1)
    scale, modules = float(np.median(lengths / np.maximum(fitted, 1e-9))), trial.used.any(axis=0)
    scale_sd = free.sd[0] / (trial.system.pinhole_distance[modules].mean() * math.sqrt(modules.sum()))
    if abs(scale - 1) > max(_MAX_SCALE, _FAR * scale_sd):
        fault = f"{scale:.3g} times as far apart as the nominal modules see them"
        warn(f"calibrate: {name}: they are {fault}, a scale; not used, the scale stays nominal")
        return free
    errors = np.abs(lengths - scale * fitted)
    typical = np.array([np.median(errors[group]) for group in groups])
    is_wrong = typical > _FAR * max(free.distance_sd, 2 * float(np.median(typical)))
    is_wrong &= len(groups) > (3 if are_points else 2)
    if is_wrong.any():
        texts = (f"{labels[i]}, {errors[groups[i]].max():.2f} mm off" for i in np.flatnonzero(is_wrong))
        warn(f"calibrate: {name}: {several(texts, 12)}, as the others and the images tell; left out")
    if are_points:
        return replace(bundle, used=free.used & ~is_wrong[:, None])
    return replace(bundle, pairs=pairs[~is_wrong], distances=lengths[~is_wrong])


def _fit_without_outliers(bundle: BundleAdjustment) -> tuple[BundleAdjustment, Floats]:
    """Solve the adjustment repeatedly, each time without further outliers; return it without them, and its solution x."""
    x, robust = bundle.start(), True
    for _ in range(_ROUNDS):
        x, used = bundle.solve(x, robust), bundle.used
        deviations = used * bundle.spot_deviations(x)
        # The median distance of two normal numbers from 0 is sqrt(2 ln 2).
        typical = max(1.0, float(np.median(deviations[used])) / math.sqrt(2 * math.log(2)))
        # All images of a module far from its nominal parameters: they are another module's, or upside down.
        outliers = used & (np.abs(bundle.module_parameters(x)) > _MAX_PRIOR).any(axis=1)
        if not outliers.any():  # otherwise only the worst spots, because they draw others away
            outliers = deviations > max(_OUTLIER * typical, float(deviations.max()) / 2)
            # With few spots left, any parameters of the module would fit.
            outliers |= used & outliers.any(axis=0) & ((used & ~outliers).sum(axis=0) <= _MIN_POINTS)
        if not outliers.any() and not robust:
            break
        robust = bool(outliers.any())
        bundle = replace(bundle, used=used & ~outliers)
        if bundle.used.any(axis=0).sum() < len(bundle.system) / 2:
            raise InputError(
                "calibrate: most modules would be farther than 5 standard deviations from the nominal geometry; expected "
                "points in the scanner's frame (or their distances instead), or larger position_sd and tilt_sd_degrees"
            )
        bundle.module_parameters(x)[outliers.any(axis=0)] = 0.0
    return bundle, x


def _make_result(views: Views, bundle: BundleAdjustment, x: Floats, spots: Spots) -> Calibration:
    """Return the result of an adjustment with the solution x: geometry, uncertainties and tests of the fit."""
    nominal, fitted, seen, used = bundle.system, bundle.geometry(x), spots.seen, bundle.used
    covariance, leverages = bundle.covariance(x)
    told = np.clip(1 - np.diagonal(covariance, axis1=1, axis2=2), 0, 1)
    units = np.broadcast_to(np.eye(len(bundle.sd)) * bundle.sd, covariance.shape).copy()
    # Shifts along the axes of the fitted module instead of the nominal one.
    units[:, :3, :3] = fitted.frames @ nominal.frames().swapaxes(1, 2) * bundle.sd[:3]
    covariance = units @ covariance @ units.swapaxes(1, 2)
    squared, (pearson, freedom) = bundle.spot_deviations(x) ** 2, spots.pearson()
    spot_freedom, pixel_freedom = (2 * used - leverages).sum(axis=0), (seen * (freedom + 2) - leverages).sum(axis=0)
    sums = ((used * squared).sum(axis=0), spot_freedom), ((seen * (pearson + squared)).sum(axis=0), pixel_freedom)
    misfit, chi_square = (np.where(n > 0.5, total / np.maximum(n, 0.5), np.nan) for total, n in sums)
    misfits = (seen & ~used).any(axis=0) | _is_improbable(misfit, spot_freedom)
    misfits |= _is_improbable(chi_square, pixel_freedom)
    warn_of_fit(spots, used, fitted, chi_square)
    expected = spots.expected(fitted.project_points())
    excess, total = ((seen[..., None, None] * w).sum(axis=0) for w in (spots.windows - expected, expected))
    further_names = {LENGTH: ("length",), OFFSET: ("offset u", "offset v")}
    names = (*_PARAMETERS, *(name for kind in bundle.fit for name in further_names[kind]))
    gauge = ("shift", "turn", "scale")[: len(bundle.gauge()) // 3 + len(bundle.gauge()) % 3]
    system = nominal.replace(centers=fitted.centers, tilt=fitted.tilt, collimator_length=fitted.length)
    return Calibration(system, nominal, _move_views(views, nominal, fitted), fitted.points, covariance[:, :6, :6],
                       chi_square, misfit, tuple(nominal.numbers[misfits].tolist()), used, names,
                       np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), told, gauge, fitted.offset,
                       excess / np.sqrt(np.maximum(total, 1)), FWHM_PER_SIGMA * spots.sigma,
                       FWHM_PER_SIGMA * spots.sigma_sd)  # fmt: skip


def _is_improbable(per_freedom: Floats, freedom: Floats) -> Bools:
    """Return whether each module's chi-square is too large, relative to the other modules', to be chance, (M,).

    `per_freedom` (M,) is chi-square per degree of freedom, `freedom` (M,) the degrees of freedom.
    """
    typical = max(1.0, float(np.nanmedian(per_freedom))) if np.isfinite(per_freedom).any() else 1.0
    scaled = np.nan_to_num(per_freedom) / typical
    p_value = scipy_module("special").chdtrc(np.maximum(freedom, 0.5), scaled * freedom)
    return np.asarray(p_value < _FALSE_ALARM / len(freedom))


def _move_views(views: Views, nominal: PinholeSystem, fitted: FittedGeometry) -> Views:
    """Return the views moved with the modules; their pixels stay on the crystals, except for the detector offsets."""
    frames, world_from_module = nominal.frames(), fitted.frames.swapaxes(1, 2)
    vectors = views.detector_centers - views.sources, views.u_steps, views.v_steps
    center, u_steps, v_steps = (np.einsum("mij,mj->mi", frames, vector) for vector in vectors)
    center[:, :2] -= (center[:, 2] / nominal.collimator_length)[:, None] * fitted.offset
    center[:, 2] *= fitted.length / nominal.collimator_length
    center, u_steps, v_steps = (np.einsum("mij,mj->mi", world_from_module, x) for x in (center, u_steps, v_steps))
    return Views(fitted.centers, fitted.centers + center, u_steps, v_steps, views.shape)
