"""PyTorch3D: the arguments of ``PerspectiveCameras`` (https://pytorch3d.org/docs/cameras)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..geometry.views import Views
from ..validation import instance
from .camera_model import camera_model
from .format import array_format


def _arrays(views: Views, *, in_ndc: bool = True) -> dict[str, Any]:
    """Cameras +X left, +Y up, +Z forward, ``X_view = X_world R + T`` on row vectors; rendered images are the arrays.

    Screen space has its origin at the outer corner of pixel (0, 0), whose centre is (0.5, 0.5). NDC spans 2 over the
    shorter side, with its origin in the middle of the image, x to the left and y up.
    """
    instance(in_ndc, bool, "in_ndc")
    camera = camera_model(views, "pytorch3d")
    half_turn = np.array([-1.0, -1.0, 1.0])  # x right, y down to x left, y up
    focal, principal = camera.focal_lengths, camera.principal_points + 0.5
    if in_ndc:
        half_side = min(views.shape) / 2
        focal = focal / half_side
        principal = (np.array(views.shape[::-1]) / 2 - principal) / half_side
    return {
        "R": camera.rotations.transpose(0, 2, 1) * half_turn,
        "T": camera.translations * half_turn,
        "focal_length": focal,
        "principal_point": principal,
        "image_size": np.tile(views.shape, (len(views), 1)),
        "in_ndc": in_ndc,
    }


PYTORCH3D = array_format("pytorch3d", "PyTorch3D: PerspectiveCameras in NDC, or in screen space", _arrays)
