"""Scores of a volume beside its truth: of all voxels (images.py), and of a phantom's rods (derenzo.py) or spheres (nema.py).

`summary.score_volume` computes all that a volume can have, and `summary.SCORES` is their table.

To add a score, write a function of volume and truth in a module here and a row of `SCORES`; a score of a phantom's parts
is a function of volume, phantom and pose that returns a `rows.Rows` with `lines`, `record` and `cells`. Text and JSON of
``mphdrr score`` follow, Blender's panel with `in_window` and the judge with `judged_from`. A plot of its own is drawn in
`core/figures/scores.py`; a public name stands in `core/__init__.py`.
"""
