"""Read a workbook, voxelize a phantom, and compute projections and their adjoint in Python, without Blender.

python package.py [scanner.xlsx]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import mphdrr.core as mph

workbook = sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent / "dc-spect-80.xlsx"
system = mph.read_system(workbook)
print(f"{len(system)} modules, b {system.pinhole_distance.min():.0f} to {system.pinhole_distance.max():.0f} mm")

# A Derenzo phantom, turned about its own axis, then tilted about y and turned about z (radians), on 128^3 voxels.
phantom = mph.DerenzoPhantom(radius=40, rod_diameters=(8, 6, 5, 4, 3, 2), height=40, activity=100)
grid = mph.Grid.centered(128, 0.8)
volume = phantom.voxelize(grid, mph.euler_pose(phi=0.5, theta=0.9, psi=0.0))

views = system[:20].views(shape=(128, 128))  # the first ring
A = mph.Projector(grid, views)
images = A(volume)  # (20, 128, 128), kBq/mL mm
backprojection = A.T(images)  # (128, 128, 128), the exact adjoint
print("projections", images.shape, "largest", images.max())
print("<A x, A x> ", float(np.vdot(images, images)))
print("<x, At A x>", float(np.vdot(volume.array, backprojection)))
