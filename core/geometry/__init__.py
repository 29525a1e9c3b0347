"""Geometry of a scanner: its modules, their frames and views, and the grid of voxels.

`PinholeSystem` (system.py) holds the pinhole modules, `Views` (views.py) the rays of images, `Grid` (grid.py) the voxels of
a volume. Systems come from a workbook (`core.workbook`) or from the generators (generators.py); `check_geometry` (checks)
tells whether a system can be built.

- A column of the workbook is one more row of `PINHOLE_COLUMNS` (pinhole_columns.py); one that the package computes with is
  also a field of `PinholeSystem`.
- A kind of scanner is a class derived from `Scanner` (scanner.py), with a line in `core/scanner_kinds.py`.
- A generator is a function in generators.py that returns a `PinholeSystem`, with a line in `core/__init__.py`.

Lengths are in mm, angles in rad; the world's origin is the isocentre, +z is along the patient (docs/conventions.md).
"""
