"""Reconstructions and back-projections of the shown run, as volumes of the scene.

`reconstructions.reconstruct_job` reconstructs while the scene shows the volume, `reconstructions.continue_job` does
further iterations, and `backprojections.backproject_job` back-projects.

A method or a prior, with its arguments as settings, is added in `core/reconstruction`, another setting in
`core/runs/settings.py`; the panel's properties follow. The numbers in the panel are the `cells` of a score: rows of `SCORES`
with `in_window` (`core/reconstruction/scores/summary.py`), put together by `_scores` in reconstructions.py.
"""
