"""Workbooks of scanners that no training has seen, made of the example's: python scanners.py SCANNER.xlsx FOLDER."""

import sys
from pathlib import Path

import numpy as np

import mphdrr.core as mph

MILLIMETRES, DEGREES = 1.0, 0.5

system, folder = mph.read_system(sys.argv[1]), Path(sys.argv[2])
rng = np.random.default_rng(1)
directions = rng.normal(size=(2, len(system), 3))
directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
scanners = {
    "moved": system.replace(centers=system.centers + 10 * directions[0]),
    "holes": system.replace(pinhole_diameter=1.4 * system.pinhole_diameter),
    "misaligned": system.replace(
        centers=system.centers + MILLIMETRES * directions[0], tilt=np.radians(DEGREES) * directions[1]
    ),
}
for name, scanner in scanners.items():
    mph.write_system(scanner, folder / f"{name}.xlsx")
