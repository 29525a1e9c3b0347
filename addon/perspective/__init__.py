"""Volumes as modules see them, epipolar lines of a picked pixel, and the colour bar of the 3D views.

`frustums.frustum_job` shows the active volume as layers in a module's own coordinates, `frustums.resample_job` takes it
through these and back. `epipolar.pick_pixel` picks a pixel of the shown run; `epipolar_drawing.py` draws its ray and
lines.

A property of frustums is a row of `PerspectiveSettings`; the conditions that make one outdated are in `frustums.changes`.

How volumes in a module's coordinates are shown is `frustums.color_values` and `_add_frustum`; the lines of a picked
pixel, in both editors, are epipolar_drawing.py, and their positions, in the shown run's views, `epipolar.PickedPixel`.
"""
