"""PyTorch3D: the arguments of ``PerspectiveCameras`` (https://pytorch3d.org/docs/cameras)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..validation import instance
from .arrays import SUFFIXES, write_arrays
from .cameras import cameras
from .format import Format


def _write(system: PinholeSystem, views: Views, path: Path, *, in_ndc: bool = True) -> None:
    """Cameras +X left, +Y up, +Z forward, ``X_view = X_world R + T`` on row vectors; rendered images are the arrays.

    Screen space has its origin at the outer corner of pixel (0, 0), so that pixel's centre is (0.5, 0.5). NDC spans 2
    over the shorter side, with its origin at the image's middle, x to the left and y up.
    """
    instance(in_ndc, bool, "in_ndc")
    seen = cameras(views, "pytorch3d")
    half_turn = np.array([-1.0, -1.0, 1.0])  # x right, y down to x left, y up
    focal, principal = seen.focal_lengths, seen.principal_points + 0.5
    if in_ndc:
        half_side = min(views.shape) / 2
        focal = focal / half_side
        principal = (np.array(views.shape[::-1]) / 2 - principal) / half_side
    arrays = {
        "R": seen.rotations.transpose(0, 2, 1) * half_turn,
        "T": seen.translations * half_turn,
        "focal_length": focal,
        "principal_point": principal,
        "image_size": np.tile(views.shape, (len(views), 1)),
        "in_ndc": in_ndc,
    }
    write_arrays(path, arrays)


PYTORCH3D = Format("pytorch3d", "PyTorch3D: PerspectiveCameras in NDC, or in screen space", SUFFIXES, _write)
