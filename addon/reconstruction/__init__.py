"""Reconstructions and back-projections of the shown run, as volumes of the scene.

`reconstructions.reconstruct_job` reconstructs while the scene shows the volume, `reconstructions.continue_job` does further
iterations, and `backprojections.backproject_job` back-projects.

A method, a prior or one of their settings is added in `core/reconstruction/methods.py` and `core/runs/settings.py`; the
panel's properties follow. A score's line in the panel is made by `_scores` in `reconstructions.py`.
"""
