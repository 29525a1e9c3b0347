"""Projection runs of the scene: the Projections panel's settings, renders, imports, the list of runs, the live preview.

`rendering.render_job` projects the scene as a recipe says, `runs.panel_recipe` is the panel's recipe, `runs.changes` says
what has changed since a run, and `preview.start` switches the live preview on.

A setting of the panel is a row of `core/runs/settings.py`: its property here, its place in the panel, its recipe key and
its comparison with the scene follow. A job that makes a run ends with `rendering.store_and_show`.

What a run is compared with the scene by is `scene_state` and `_differences` (runs.py). The live preview reads the scene
in `preview.read_request` and projects in `make_preview`; preview_drawing.py draws it, `panels/preview_gizmo.py` drags it.
Calibrate is calibrating.py, whose modules move in `addon/scanner/module_edits.move_modules`.
"""
