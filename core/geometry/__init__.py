"""Geometry of a scanner: its modules, their frames and views, and the grid of voxels.

`PinholeSystem` (system.py) holds the pinhole modules, `Views` (views.py) the rays of images, `Grid` (grid.py) the voxels
of a volume. Systems come from a workbook (`core.workbook`) or from the generators (generators.py); `check_geometry`
(checks) tells whether a system can be built.

- A column of the workbook is one more row of `PINHOLE_COLUMNS` (pinhole_columns.py), which says all about it (`Column` in
  columns.py): headings, kind, unit, limits, help, its place in a new workbook, and with `blank` that it is optional.
  Workbook, column maps, ``geometry set``, panel, run files and JSON follow, and the values are an attribute of the
  system; one that the package computes with is also a field of `PinholeSystem`.
- A kind of scanner is a class derived from `Scanner` (scanner.py) in a room of its own, and a line in
  `core/scanner_kinds.py`; `core/xray/system.py` and `tests/blender/test_xray_scanner.py` are examples. A camera's view of
  a module is the kind's `fields`; what no scanner of a kind can have, such as two pinholes at one place, is its `faults`,
  of which reader and writer name the cell.
- A generator is a function in generators.py that returns a `PinholeSystem`, with a line in `core/__init__.py`; its
  options stand in `core/cli/geometry/generate.py`.
- The parts' colours, in the scene and in exported solids, are `LOOKS` (part_colors.py).

Lengths are in mm, angles in rad; the world's origin is the isocentre, +z is along the patient (docs/conventions.md).
"""
