"""The model of SPECT: expected counts of each pixel of a crystal behind a pinhole."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from ..arrays import ArrayOrTensor, Floats, Floats32, is_tensor
from ..errors import InputError, naming
from ..geometry.collimator import OPENING_ANGLE
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..physics.aperture import Opening
from ..physics.aperture import points_needed as hole_points_needed
from ..physics.energy_window import FWHM_PER_SIGMA
from ..physics.isotopes import Isotope
from ..physics.optics import Edge, Optics
from ..pinhole_response.directional_effects import DirectionalEffects
from ..pinhole_response.pinhole_operator import PinholeOperator
from ..rays.bundles import Beam
from ..rays.ray_geometry import Fan, view_rays
from ..validation import instance, positive, real_array, strict_whole
from ..volumes.volume import Volume
from . import detector_blur, emission_warnings
from .model import Model, checked_background, checked_times, require_views_of
from .photon_lines import checked_mu, checked_photons, line_models, mu_volumes
from .pixel_points import TOLERANCE, lattices, offsets, points_needed, require_points, shadow_edges
from .wall_penetration import models_with_walls

_BOX_PER_SIGMA = math.sqrt(12)  # width of a box with the variance of a Gaussian of sigma 1

Hole = Literal["auto", "depth", "rays", "point"]
_APERTURE_TOLERANCE = 0.1  # default of `aperture_tolerance`


@dataclass(frozen=True, eq=False)
class Emission(Model):
    """Expected counts per pixel of a volume of activity (kBq/mL, which is decays per s and mm^3).

    A ray of the pixel that leaves the pinhole at an angle psi to the principal ray contributes ::

        time * d_e^2 p_u p_v cos^4(psi) / (16 l^2) * efficiency * integral of f exp(-integral of mu) dr

    with p the pixel pitch on the crystal (for a virtual detector that of its image there), d_e the effective diameter of
    the pinhole and l the collimator's length. Summed over the pixels this is the sensitivity to a point source at
    height h above the pinhole's plane and elevation theta: ``g = d_e^2 sin^3(theta) / (16 h^2)``. The 1/r^2 of that law
    is in the density of the rays. Rays run from the pinhole through the whole grid, wherever a virtual detector stands.
    By default the hole has its size and its blur; nothing is attenuated, no photon penetrates the edge or the crystal.

    Attributes
    ----------
    system : PinholeSystem
        The modules, as many as the views and in their order: ``Emission(system[0:20])`` for
        ``system[0:20].views(...)``.
    mu : Volume, or a sequence of them, optional
        Attenuation coefficients ("mu", 1/mm) at the energy of the detected photons, on the activity's grid or any other. The
        result is exact for piecewise constant volumes: nothing is resampled, the planes of both grids cut the rays, and
        ``exp(-integral of mu)`` is integrated in closed form inside a voxel. CT numbers ("hu") become the mu of each of
        `photon_lines` by `hu_to_mu`; a sequence has one volume of mu for each of these lines, in their order. None: no
        attenuation.
    time : float or array (M,)
        Duration of the acquisition, s, or of each module's frame.
    start : float or array (M,)
        Start of the acquisition, or of each module's frame, s after the reference time of the activity.
    isotope : Isotope or str, optional
        Isotope whose photons are detected. The volume is its activity at the reference time, which decays until `start` and
        during `time`. None: one photon per decay, and constant activity.
    window : tuple of (float, float), optional
        Energy window, keV, in which photons are detected. None: 10 % around the isotope's strongest line.
    energy_fwhm : float, optional
        FWHM of the detector's energy resolution at the strongest line in the window, as a share of its energy; at an energy
        E the FWHM is in proportion to sqrt(E). So a part of each line is detected, also of lines beside the window; lines
        with less than 1e-4 of the counts of the strongest are left out. None: all photons of the lines within the window.
    lines : str
        Several lines ``"together"`` are photons of one kind, with effective coefficients. ``"apart"``: each line has its own
        mu, aperture and crystal, the images are the sum of the lines' images and take as many times as long. With CT
        numbers, or several volumes of mu, lines are apart.
    photons_per_decay : float, optional
        Number of photons per decay, instead of the isotope's.
    pixel_points : int, optional
        Number of points of each pixel's area, for each point of the hole, from which rays start. None: as many as
        `tolerance` requires: small voxels on large pixels take many. A number of your own is used as it is, with a warning
        if it is too small for the tolerance; with `intrinsic_fwhm` each part of a pixel has as many. 1, with one point of
        the hole: the pixels' centres alone.
    tolerance : float
        Largest relative error of the total counts of a single voxel in any module, wherever it lies between the rays: 2 %
        by default. Larger sources are more accurate.
    hole : str
        ``"depth"``: the depth-dependent pinhole response, the blur of the whole hole without rays. Every voxel's image is
        right to 1 % and its total to 0.1 %; with `depth_layers` to 2 % and 0.35 %. It takes no grid that comes close to a
        pinhole, and no backend cuda. ``"rays"``: lines through `aperture_points`. ``"point"``: lines through the hole's
        centre, an ideal pinhole without blur. ``"auto"``: the depth-dependent response, and rays for voxels close to a
        pinhole; rays alone where the response is not available, or where a number of rays is given.
    aperture_points : int, optional
        Number of points of the hole's disc that rays pass, all with the same weight: the blur of a hole of diameter d_e.
        With 1 all rays pass the centre and there is no blur; otherwise at least 3. None: by `aperture_tolerance`.
    aperture_tolerance : float, optional
        Accuracy that chooses the number of points, instead of `aperture_points`: the absolute differences of the pixels
        between the images of one voxel at the isocentre through the points and through the whole hole sum to at most this
        share of the counts; so they do for any activity around the isocentre. None: 0.1.
    aperture_mu : float, array (M,) or str, optional
        Attenuation coefficient of the aperture's material at the photons' energy, 1/mm, or the material's name
        (``"tungsten"``, see `MATERIALS`). Of several lines in the window the coefficient is the one that lets as many
        photons pass as all lines together (`module_coefficients`). None: no penetration, d_e = d.
    opening_angle : float
        Full angle alpha of the knife edge's double cone, rad.
    plate_thickness : float or array (M,), optional
        Thickness of the plate, mm, with the knife edge in its middle; for edge "path". Photons that pass the plate where it
        is solid, far from the hole, are detected with `wall_thickness` alone; from 0.5 % on a warning says so. None:
        infinite.
    wall_thickness : float, optional
        Thickness of the collimators' walls, mm, of the aperture's material. Photons are then detected, too, that pass a
        module's own walls or plate beside its hole, or a neighbour's hole and then walls: by rays (`wall_penetration`).
        Neighbours are the other modules of `system`. None: nothing passes walls.
    edge : str
        Law by which photons penetrate the knife edge. ``"paix"``: as if the hole had the diameter d_e with ``d_e^2 = d (d +
        2 / mu tan(alpha / 2))`` (Paix 1967), in every direction. ``"path"``: rays beyond the rim are weighted with ``exp(-mu
        path)`` for their path through the edge, which is as thick as the cone continues; rays steeper than the cone are
        blocked. On the axis this gives ``d_e^2 = d^2 + 2 d / mu tan(alpha / 2) + 2 / mu^2 tan^2(alpha / 2)`` (Metzler 2001).
        Neither needs a correction for obliquity: at psi the hole's area is cos(psi) times the disc's, which is in
        cos^4(psi). By rays through one point the edge changes only the counts; through n points, also the blur, with about 4
        sqrt(pi n) more rays.
    crystal_mu : float, array (M,) or str, optional
        Attenuation coefficient of the crystal at the photons' energy, 1/mm, or its name (``"NaI"``), as for the aperture.
        The fraction ``1 - exp(-crystal_mu Td / cos(psi))`` of the photons is then detected. None: all.
    depth_layers : int
        Number of depths in the crystal at which photons are absorbed, with `crystal_mu`: the deeper, the farther out oblique
        rays are recorded (parallax). From 2 on, counts and mean depth are exact for every angle; the depth-dependent
        response then has all depths, whatever the number. With 1 all photons are recorded where they enter.
    intrinsic_fwhm : float
        FWHM of the detector's Gaussian blur, mm on the crystal, of photons before pixels count them: images are computed
        in parts of pixels, as many as misplace at most 0.3 % of the counts. Those blurred over the image's edge are lost.
    within_crystal : bool
        Whether nothing is detected outside the crystal's side Ld; a pixel across its edge detects with the part inside.
    within_walls : bool
        Whether the collimator's walls stop photons that would enter through the crystal's sides, or miss it. The walls run
        straight from the hole's rim to the edges of the crystal's front, so they stop no others.
    within_cone : bool
        Whether rays steeper than the knife edge's cone, psi > alpha / 2, are blocked, with either edge.
    background : float or array (M,) or (M, n_v, n_u)
        Expected counts of each pixel in the whole acquisition besides those of the volume, such as scatter and dark counts.
        ``A(x)`` leaves them out; runs add them before noise is drawn, and reconstructions expect them. Dead pixels have
        none.
    efficiency : float or array (M,) or (M, n_v, n_u)
        Factors of the counts of the volume, for each module or pixel, as `flood_efficiency` gives them. Where it is 0 the
        pixel is dead: nothing is expected there, and reconstructions leave it out.

    References
    ----------
    D. Paix, "Pinhole imaging of gamma rays", Physics in Medicine and Biology 12 (1967) 489-500.
    S. D. Metzler, J. E. Bowsher, M. F. Smith, R. J. Jaszczak, "Analytic determination of pinhole collimator sensitivity
    with penetration", IEEE Transactions on Medical Imaging 20 (2001) 730-741.
    """

    system: PinholeSystem
    mu: Volume | Sequence[Volume] | None = None  # type: ignore[assignment]  # a sequence with several lines alone
    time: float | Floats = 1.0
    photons_per_decay: float = None  # type: ignore[assignment]  # always a number in a model
    aperture_points: int | None = None
    aperture_mu: float | str | None = None  # a number in a model, not a name
    opening_angle: float = OPENING_ANGLE
    crystal_mu: float | str | None = None  # a number in a model, not a name
    intrinsic_fwhm: float = 0.0
    within_crystal: bool = False
    isotope: Isotope | str | None = None
    window: tuple[float, float] | None = None
    aperture_tolerance: float | None = None
    edge: Edge = "paix"
    depth_layers: int = 1
    within_walls: bool = False
    within_cone: bool = False
    pixel_points: int | None = None
    tolerance: float = TOLERANCE
    background: float | Floats = 0.0  # type: ignore[assignment]  # arrays are checked, and read-only
    hole: Hole = "auto"
    start: float | Floats = 0.0
    efficiency: float | Floats = 1.0  # type: ignore[assignment]  # arrays are checked, and read-only
    energy_fwhm: float | None = None
    lines: Literal["together", "apart"] = "together"
    plate_thickness: float | None = None
    wall_thickness: float | None = None

    name = "emission"
    takes = ("activity",)
    has_times = True
    has_geometry_gradient = True
    ends_at_detector = False

    def __post_init__(self) -> None:
        instance(self.system, PinholeSystem, "emission")
        self._set_optics()
        self._set("tolerance", positive(self.tolerance, "emission: tolerance"))
        self._set("time", checked_times(self.time, "emission: time", len(self.system)))
        self._set("start", checked_times(self.start, "emission: start", len(self.system), is_positive=False))
        if self.aperture_tolerance is not None:
            self._set("aperture_tolerance", positive(self.aperture_tolerance, "emission: aperture_tolerance"))
        if self.aperture_points is not None:
            points = strict_whole(self.aperture_points, "emission: aperture_points", "1, 3 or more")
            self._set("aperture_points", points)
            if points == 2:
                raise InputError("emission: aperture_points: expected 1, 3 or more, got 2")
            if self.aperture_tolerance is not None:
                raise InputError("emission: give aperture_points or aperture_tolerance, not both")
        self._set("pixel_points", require_points(self.pixel_points, "emission: pixel_points"))
        for name in ("background", "efficiency"):
            self._set(name, checked_background(getattr(self, name), f"emission: {name}", len(self.system)))
        if self.hole not in ("auto", "depth", "rays", "point"):
            raise InputError(f"emission: hole: expected 'auto', 'depth', 'rays' or 'point', got {self.hole!r}")
        has_points = (self.aperture_points, self.aperture_tolerance) != (None, None)
        if self.wall_thickness is not None:
            self._set("wall_thickness", positive(self.wall_thickness, "emission: wall_thickness", "mm"))
            if self.aperture_mu is None:
                raise InputError("emission: wall_thickness needs aperture_mu, of the walls' material")
        if has_points and self.hole in ("depth", "point"):
            raise InputError(f"emission: hole {self.hole!r} takes no points; leave them out, or use hole 'rays'")

    @property
    def is_by_depth(self) -> bool:
        """Whether the hole's blur is computed without rays."""
        if self.hole != "auto":
            return self.hole == "depth"
        return {self.aperture_points, self.aperture_tolerance, self.pixel_points} == {None}

    @property
    def has_one_kernel(self) -> bool:
        """Whether the hole's blur is the same for all directions: no path through the edge, no depths in the crystal."""
        return self.edge == "paix" and self.depth_layers == 1

    def by_rays(self) -> Self:
        """Return the model for backends that know rays alone; raise `InputError` with hole "depth"."""
        if self.hole == "depth":
            raise InputError("emission: hole 'depth' takes no backend 'cuda': use hole 'auto'")
        return replace(self, hole="rays") if self.hole == "auto" else self

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def _set_optics(self) -> None:
        """Check the fields of photons, mu and `Optics`, and replace names of isotopes and materials by their values."""
        for name, value in checked_photons(self).items():
            self._set(name, value)
        self._set("mu", checked_mu(self.mu, self.photon_lines))
        with naming("emission"):
            settings = {f.name: getattr(self, f.name) for f in fields(Optics)}
            settings = {name: real_array(x, name, None) if is_tensor(x) else x for name, x in settings.items()}
            optics = Optics.of(self.system, self.photon_lines, **settings)
        if self.is_apart:
            self._set("optics", optics)
        for f in fields(Optics):
            # With lines apart the name of a material stays: each line has its own coefficient.
            if not (self.is_apart and f.name.endswith("_mu") and np.ndim(settings[f.name]) == 0):
                self._set(f.name, getattr(optics, f.name))

    @property
    def is_apart(self) -> bool:
        """Whether each photon line has a model of its own."""
        is_one = self.mu is None or (isinstance(self.mu, Volume) and self.mu.quantity == "mu")
        return len(self.photon_lines) > 1 and (self.lines == "apart" or not is_one)

    def parts(self) -> tuple[Model, ...]:
        """Return the models whose images add up: one per line if lines are apart, those with walls, or the model alone."""
        return (self,) if self.wall_thickness is None and not self.is_apart else self._models

    @cached_property
    def _models(self) -> tuple[Model, ...]:
        """The models whose images add up to this model's, see `parts`."""
        return line_models(self, self.photon_lines) if self.is_apart else models_with_walls(self)

    def record(self) -> dict[str, Any]:
        """Return the settings for the record of a run, by name: of mu the grids, of the isotope its name, not images."""
        settings = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("system", "mu")}
        settings["isotope"] = None if self.isotope is None else self.isotope.name  # type: ignore[union-attr]
        settings["window"] = None if self.window is None else list(self.window)
        for name, value in settings.items():
            if isinstance(value, np.ndarray):
                settings[name] = value.tolist() if value.ndim == 1 else "images"
        volumes = mu_volumes(self.mu)  # type: ignore[arg-type]  # in a model a tuple, not any sequence
        if grids := [{"shape": list(mu.grid.shape), "affine": mu.grid.affine.tolist()} for mu in volumes]:
            settings["mu"] = grids if isinstance(self.mu, tuple) else grids[0]
        return settings

    @property
    def effective_time(self) -> float | Floats:
        """Time, s, or (M,), in which constant activity, as at the reference time, would decay as often as it does."""
        isotope: Any = self.isotope
        return self.time if isotope is None else isotope.mean_decay_time(self.time, self.start)

    @property
    def detected_energies(self) -> tuple[float, float] | None:  # type: ignore[override]
        """Energy window, keV; None without one."""
        return self.window

    def coarse(self) -> Self:
        """Return the model of opaque holes and few rays, with this model's times and efficiencies."""
        time, efficiency = self.effective_time, self.efficiency
        return type(self)(self.system, time=time, efficiency=efficiency, pixel_points=1, tolerance=1e9)

    def without_blur(self) -> Self:
        """Return the model of ideal pinholes and crystals: one ray through the hole's centre for each pixel."""
        return replace(
            self, hole="point", aperture_points=None, aperture_tolerance=None, pixel_points=1, depth_layers=1
        )

    def unit(self, volume: Volume) -> str:
        """Return the unit of the images of `volume`."""
        return "counts"

    def of_views(self, which: NDArray[np.integer]) -> Self:
        """Return the model of the modules `which` alone, indices from 0."""
        arrays = ((f.name, getattr(self, f.name)) for f in fields(self))
        chosen = {name: array[which] for name, array in arrays if isinstance(array, np.ndarray)}
        model = replace(self, system=self.system[which], **chosen)
        if self.parts() != (self,):  # the attenuation of lines is computed once, and neighbours stay neighbours
            model._set("_models", tuple(part.of_views(which) for part in self.parts()))
        return model

    def check(self, views: Views) -> None:
        """Raise `InputError` unless `views` are of this system."""
        require_views_of(self.system, views, "emission")
        for name in ("background", "efficiency"):
            checked_background(getattr(self, name), f"emission: {name}", len(views), views.shape)

    @cached_property
    def optics(self) -> Optics:
        """Settings of hole, edge, walls, cone, crystal and photons, for `sensitivity`, maps and cameras in torch."""
        return Optics(**{f.name: getattr(self, f.name) for f in fields(Optics)})

    @cached_property
    def _frames(self) -> Floats:
        return self.system.frames()

    @property
    def effective_diameter(self) -> Floats:
        """Effective diameter d_e (M,), mm, of an opaque hole that lets as many photons pass along the axis."""
        return self.optics.effective_diameter(self.system.pinhole_diameter)

    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """Yield rays of view m from the pinhole through the grid, weighted with counts per (decay / (s mm^3) mm)."""
        u, v, k = self._frames[m]
        l = self.system.collimator_length[m]
        pinhole, rays, scale = views.sources[m], view_rays(views, m), self._crystal_scale(views, m)
        # Position of the first pixel on the crystal, mm from its centre, point-inverted.
        first = scale * (rays.corner - pinhole) - l * k
        pitch_u, pitch_v = self.crystal_pitch(views, m)
        n_v, n_u = views.shape
        pixels_v = (first @ v + scale * (rays.row_step @ v) * np.arange(n_v))[:, None]
        pixels_u = (first @ u + scale * (rays.column_step @ u) * np.arange(n_u))[None, :]
        # To the plane through the grid's farthest corner.
        depth = max(float(((grid.corners() - pinhole) @ k).max()), l)
        n_hole = self.hole_points(views, m, grid)
        openings = self.openings(m, n_hole)
        n = self.pixel_points_needed(views, m, grid)

        def weights(points: Floats, opening: Opening, layer: int, rows: slice, columns: slice, shifts: slice) -> Floats:
            """Return the weights of the chosen pixels' rays, averaged over the `points` of a pixel."""
            points_u, points_v = points[shifts].T[:, :, None, None]
            u_ends, v_ends = pixels_u[:, columns] + points_u, pixels_v[rows] + points_v
            return self.pixel_weights(m, u_ends, v_ends, (pitch_u, pitch_v), l, opening, layer, n * len(openings)) / n

        for layer, z in enumerate(self.optics.depths(self.system.detector_thickness[m])):
            stretch = depth / (l + z)
            steps = stretch * scale * rays.row_step, stretch * scale * rays.column_step
            for opening, start in zip(openings, lattices(n_hole, len(openings)), strict=True):
                point = opening.x * u + opening.y * v
                shift = None
                if len(openings) > 1:
                    # Seen from the isocentre, the points of all openings together fill the pixel evenly.
                    shadow = (1 + l / self.system.pinhole_distance[m]) * np.array([opening.x, opening.y])
                    shift = start / math.sqrt(n) - shadow / (pitch_u, pitch_v)
                points = offsets(n, shift) * (pitch_u, pitch_v)
                corner = pinhole + point + depth * k + stretch * (first + point)
                shifts = points[:, ::-1] / (scale * (rays.row_step @ v), scale * (rays.column_step @ u))
                fan = Fan(pinhole + point, corner, *steps, views.shape, shifts)
                yield Beam(fan, partial(weights, points, opening, layer))

    def pixel_weights(
        self,
        m: int,
        along_u: ArrayOrTensor,
        along_v: ArrayOrTensor,
        pitch: tuple[float, float],
        length: float,
        opening: Opening,
        layer: int = 0,
        cells: int = 1,
    ) -> ArrayOrTensor:
        """Return module m's expected counts per (decay / (s mm^3) mm) along rays through one point of the hole.

        Parameters
        ----------
        m
            Number of the module, which determines the crystal's side and thickness.
        along_u, along_v
            Positions on the crystal where the rays end, mm from its centre and point-inverted: arrays or tensors that
            broadcast.
        pitch
            Size of a pixel on the crystal, mm along u and v.
        length
            Collimator length l, mm.
        opening
            The point of the hole.
        layer
            Number of the depth, of `depth_layers` from the front, at which photons are recorded.
        cells
            Number of rays of a pixel: where the crystal or a wall ends, a ray stands for this part of each side.
        """
        side, thickness = self.system.detector_side[m], self.system.detector_thickness[m]
        optics, *along, length = self._optics_of(m).promoted(along_u, along_v, length)
        seconds = float(np.broadcast_to(self.effective_time, len(self.system))[m])
        return seconds * optics.pixel_weights(along, pitch, length, side, thickness, opening, layer, cells)

    def pixel_parts(self, views: Views, grid: Grid) -> int:
        """Return the number of parts of a pixel's side that are blurred apart, as many as the module with most needs."""
        return detector_blur.pixel_parts(self, views, grid) if np.any(self.intrinsic_fwhm) else 1

    def response(self, views: Views, m: int, parts: int) -> tuple[Floats, Floats] | None:
        """Return the matrices of the intrinsic blur of view m, as `Model.response`; None without blur."""
        return detector_blur.matrices(self, views, m, parts) if np.any(self.intrinsic_fwhm) else None

    def by_depth(self, views: Views, grid: Grid) -> PinholeOperator | None:
        """Return the depth-dependent pinhole response, or None if the hole's blur is computed by rays."""
        if not self.is_by_depth:
            return None
        is_bounded = self.within_crystal or self.within_walls
        sides = self.system.detector_side if is_bounded else np.full(len(self.system), np.inf)
        # The path through the edge, depths in the crystal and its side are not in the rays' weights: the response has them.
        plain = replace(self, within_crystal=False, within_walls=False, depth_layers=1, edge="paix",
                        plate_thickness=None, within_cone=self.within_cone or self.edge == "path")  # fmt: skip
        sizes = zip(self.system.pinhole_diameter.tolist(), self.system.detector_thickness.tolist(), strict=True)
        effects = [DirectionalEffects.from_optics(self._optics_of(m), *size) for m, size in enumerate(sizes)]
        lengths = self.system.collimator_length + [module.mean_depth for module in effects]

        blurred = [detector_blur.has_wide_blur(self, views, m) for m in range(len(self.system))]
        modules = self._frames, lengths, plain.effective_diameter, sides, partial(plain._ray_weight, lengths)
        settings: Any = self.mu, self.hole == "depth", None if self.has_one_kernel else effects, blurred
        return PinholeOperator(views, grid, *modules, *settings)

    def _ray_weight(self, lengths: Floats, m: int, *, u: Floats, v: Floats) -> Floats:
        """Return the expected counts per mm^2 of crystal, at `lengths` (M,), of module m's rays to (v, u), mm, on it."""
        (opening,) = self.openings(m, 1)
        return self.pixel_weights(m, u, v, (1.0, 1.0), float(lengths[m]), opening)

    def caution(self, views: Views, grid: Grid) -> str | None:
        """Return a warning if there are too few rays for the tolerance, or None."""
        return None if self.is_by_depth else emission_warnings.ray_caution(self, views, grid)

    def coefficient_warnings(self) -> Iterator[str]:
        """Yield a warning for each attenuation coefficient that looks wrong; with lines apart each text once."""
        parts: Any = self.parts() if self.is_apart else (self,)
        yield from dict.fromkeys(text for part in parts for text in emission_warnings.coefficient_warnings(part))

    def mu_warnings(self, mu: Floats32) -> Iterator[str]:
        """Yield a warning if `mu` is much larger than bone's where it attenuates most."""
        return emission_warnings.mu_warnings(mu, self)

    def image_warnings(self, volume: Volume, views: Views) -> Iterator[str]:
        """Yield a warning of activity below 0 or outside maps of mu, and of images that reach beyond the crystals."""
        return emission_warnings.image_warnings(volume, views, self)

    def pixel_points_needed(self, views: Views, m: int, grid: Grid) -> int:
        """Return the number of points of each pixel of view m, for each point of the hole."""
        if self.pixel_points is not None:
            return self.pixel_points
        return points_needed(shadow_edges(views, m, grid), self.tolerance, self.hole_points(views, m, grid))

    def hole_points(self, views: Views, m: int, grid: Grid) -> int:
        """Return the number of points of the hole that rays of view m pass, by `aperture_points` or `aperture_tolerance`."""
        if self.hole == "point" or self.aperture_points is not None:
            return self.aperture_points or 1
        l, b = self.system.collimator_length[m], self.system.pinhole_distance[m]
        pitch_u, pitch_v = self.crystal_pitch(views, m)
        sigma = self._optics_of(m).intrinsic_fwhm / FWHM_PER_SIGMA
        voxel = grid.voxel_volume ** (1 / 3) * l / b
        blur = math.hypot(voxel, _BOX_PER_SIGMA * sigma)
        shadow = self.effective_diameter[m] * (1 + l / b)
        tolerance = self.aperture_tolerance or _APERTURE_TOLERANCE
        return hole_points_needed(tolerance, float(shadow), (pitch_u, pitch_v), (blur, blur))

    def openings(self, m: int, n: int) -> list[Opening]:
        """Return the points where rays of module m cross the pinhole's plane: n in the hole, and those of its edge."""
        return self._optics_of(m).openings(self.system.pinhole_diameter[m], n)

    def _optics_of(self, m: int) -> Optics:
        return self.optics.of_modules(m, len(self.system))

    def _crystal_scale(self, views: Views, m: int) -> float:
        """Return the scale from the detector plane of view m to the crystal: mm there per mm on the plane."""
        distance = (views.detector_centers[m] - views.sources[m]) @ self._frames[m, 2]
        return float(self.system.collimator_length[m] / distance)

    def crystal_pitch(self, views: Views, m: int) -> tuple[float, float]:
        """Return the size of a pixel on the crystal, mm along u and v."""
        scale = self._crystal_scale(views, m)
        return scale * float(np.linalg.norm(views.u_steps[m])), scale * float(np.linalg.norm(views.v_steps[m]))
