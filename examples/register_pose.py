"""Find the pose of a camera from its radiograph of a CT, by gradient descent.

    python register_pose.py ct.nii.gz [--degrees 10] [--millimetres 20] [--pixels 128] [--seed 0]

A radiograph is made from a known pose. The search starts from a pose rotated and shifted from it in random directions, and
its remaining error is printed. Needs torch and roma: pip install "mphdrr[torch]".
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

import mphdrr.core as mph
from mphdrr.core.exchange.diffdrr.pose_search import pose_error, register_pose
from mphdrr.core.geometry.rotations import pose_matrix, se3_exp
from mphdrr.core.projector.torch_cameras import pinhole_images

WATER = 0.02  # 1/mm, at about 70 keV
DISTANCE = 1000.0  # mm, source to detector
SOURCE = 700.0  # mm, source to the CT's centre
SIDE = 512.0  # mm, the detector's


def main() -> None:
    """Make a radiograph, move the camera away and print how near the registration comes to the true pose."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ct", help="NIfTI file of CT numbers")
    parser.add_argument("--degrees", type=float, default=10.0, help="rotation of the start about the CT's centre")
    parser.add_argument("--millimetres", type=float, default=20.0, help="shift of the start")
    parser.add_argument("--pixels", type=int, default=128, help="pixels along a side of the radiograph")
    parser.add_argument("--seed", type=int, default=0, help="of the directions of rotation and shift")
    arguments = parser.parse_args()

    ct = mph.read_volume(arguments.ct, quantity="hu")
    mu = mph.Volume(WATER * np.clip(1 + ct.array / 1000, 0, None), ct.grid, "mu")
    middle = torch.tensor(ct.grid.center)
    # Looking along +y with +z up: columns u, v, k.
    looking = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64).T
    truth = pose_matrix(looking, middle - SOURCE * looking[:, 2])
    pitch = SIDE / arguments.pixels
    image = pinhole_images(mu, truth[:3, 3], truth[:3, :3], DISTANCE, pitch, (arguments.pixels, arguments.pixels))

    generator = torch.Generator().manual_seed(arguments.seed)
    shift, axis = torch.nn.functional.normalize(torch.randn((2, 3), generator=generator, dtype=torch.float64))
    motion = se3_exp(torch.cat([arguments.millimetres * shift, np.radians(arguments.degrees) * axis]))
    to_middle = pose_matrix(torch.eye(3, dtype=torch.float64), middle)
    start = to_middle @ motion @ torch.linalg.inv(to_middle) @ truth

    began = time.perf_counter()
    found = register_pose(image, mu, start, DISTANCE, pitch)
    print(f"{len(found.similarities)} steps in {time.perf_counter() - began:.1f} s")
    for name, pose, similarity in (
        ("start", start, found.similarities[0]),
        ("found", found.pose, found.similarities[-1]),
    ):
        angle, apart = pose_error(pose, truth, middle)
        print(f"{name}: {np.degrees(angle):7.4f} degrees, {apart:7.4f} mm from the truth, similarity {similarity:.4f}")


if __name__ == "__main__":
    main()
