"""NeRF: ``transforms.json`` as nerfstudio and instant-ngp read it (https://docs.nerf.studio/quickstart/data_conventions.html)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from .cameras import cameras
from .format import Format


def _write(system: PinholeSystem, views: Views, path: Path, *, pictures: str = "images/view_{}.png") -> None:
    """Cameras +X right, +Y up, looking along -Z, of pictures as the pinhole sees them (`mosaic.as_seen`).

    Numbers that all views share stand at the top, the others in the frames. cx and cy count from the outer corner of
    the top left pixel, whose centre is (0.5, 0.5).
    """
    if not isinstance(pictures, str) or "{}" not in pictures:
        raise InputError(f"pictures {pictures!r}: expected a file name with {{}} for the view's number")
    seen = cameras(views, "nerf", mirrored=False)
    n_v, n_u = views.shape
    # The picture is the array turned by 180 degrees, and so is the camera; then x right, y down becomes x right, y up.
    axes = seen.rotations * np.array([-1.0, 1.0, -1.0])[:, None]
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    poses[:, :3, :3] = axes.transpose(0, 2, 1)
    poses[:, :3, 3] = seen.centers
    corner = np.array([n_u, n_v]) - 0.5 - seen.principal_points
    intrinsics = {
        "camera_angle_x": 2 * np.arctan(n_u / 2 / seen.focal_lengths[:, 0]),
        "fl_x": seen.focal_lengths[:, 0],
        "fl_y": seen.focal_lengths[:, 1],
        "cx": corner[:, 0],
        "cy": corner[:, 1],
    }
    common = {name: values[0] for name, values in intrinsics.items() if np.ptp(values) < 1e-9}  # but for rounding
    numbers = system.numbers if len(system) == len(views) else np.arange(1, len(views) + 1)
    digits = len(str(numbers.max()))
    frames: list[dict[str, Any]] = [
        {
            "file_path": pictures.replace("{}", f"{number:0{digits}d}"),
            **{name: float(values[m]) for name, values in intrinsics.items() if name not in common},
            "transform_matrix": poses[m].tolist(),
        }
        for m, number in enumerate(numbers)
    ]
    document = {
        "camera_model": "PINHOLE",
        "w": n_u,
        "h": n_v,
        **{name: float(value) for name, value in common.items()},
        "frames": frames,
    }
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


NERF = Format("nerf", "NeRF: transforms.json of nerfstudio and instant-ngp", (".json",), _write)
