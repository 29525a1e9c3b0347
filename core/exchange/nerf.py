"""NeRF: ``transforms.json`` as nerfstudio and instant-ngp read it (https://docs.nerf.studio/quickstart/data_conventions.html)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from .camera_model import camera_model
from .format import Format


def _write(system: PinholeSystem, views: Views, path: Path, *, pictures: str = "images/view_{}.png") -> None:
    """Cameras +X right, +Y up, looking along -Z, of pictures as the pinhole sees them (`mosaic.as_seen`).

    Numbers that all views share stand at the top, the others in the frames. cx and cy count from the outer corner of the
    top left pixel, whose centre is (0.5, 0.5).
    """
    if not isinstance(pictures, str) or "{}" not in pictures:
        raise InputError(f"pictures {pictures!r}: expected a file name with {{}} for the view's number")
    camera = camera_model(views, "nerf", mirrored=False)
    n_v, n_u = views.shape
    # The picture is the array turned by 180 degrees, and so is the camera; then x right, y down becomes x right, y up.
    axes = camera.rotations * np.array([-1.0, 1.0, -1.0])[:, None]
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    poses[:, :3, :3] = axes.transpose(0, 2, 1)
    poses[:, :3, 3] = camera.centers
    (fl_x, fl_y), (cx, cy) = camera.focal_lengths.T, (np.array([n_u, n_v]) - 0.5 - camera.principal_points).T
    intrinsics = {"camera_angle_x": 2 * np.arctan(n_u / 2 / fl_x), "fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy}
    common = {name: float(values[0]) for name, values in intrinsics.items() if np.ptp(values) < 1e-9}
    numbers = system.numbers if len(system) == len(views) else np.arange(1, len(views) + 1)
    digits = len(str(numbers.max()))
    frames = [
        {
            "file_path": pictures.replace("{}", f"{number:0{digits}d}"),
            **{name: float(values[m]) for name, values in intrinsics.items() if name not in common},
            "transform_matrix": poses[m].tolist(),
        }
        for m, number in enumerate(numbers)
    ]
    document = {"camera_model": "PINHOLE", "w": n_u, "h": n_v, **common, "frames": frames}
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


NERF = Format("nerf", "NeRF: transforms.json of nerfstudio and instant-ngp", (".json",), _write)
