"""Projection runs of the scene: the Projections panel's settings, renders, imports, the list of runs, the live preview.

`rendering.render_job` projects the scene as a recipe says, `runs.panel_recipe` is the panel's recipe, `runs.changes` says
what has changed since a run, and `preview.start` switches the live preview on.

A setting of the panel is a row of `core/runs/settings.py`: its property here, its place in the panel, its recipe key and
its comparison with the scene follow. A job that makes a run ends with `rendering.store_and_show`.
"""
