"""Geometry between views: the coordinates (u, v, k) of one view, the relations of pairs, the agreement of many.

Entry points: `PerspectiveGrid` with `to_perspective` and `from_perspective` (a volume in a view's own coordinates),
`fundamental_matrix` and `epipolar_segments` (the line in one view on which another view's pixel lies), `fit_marker` (a
point from its pixels) and `backproject` (a volume from all images, without a model). The equations are in
docs/perspective.md.

To add a way of combining the views of a voxel, add a row to `HOW` in backprojection.py, its number in places.py, and its
case in the C kernel (core/rays/backends/kernels/places.c) as in its numpy twin, `_gather_in_numpy`; the window's words
for it are `HOW_LABELS` (addon/reconstruction/reconstruction_properties.py), and a run's images become line integrals in
`core/runs/backprojecting.py`. To add a relation of rays, start from `view_rays`, which covers pinhole and parallel views
with any pixel steps.
"""
