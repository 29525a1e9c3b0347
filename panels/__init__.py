"""Panels, menus and gizmos of the window: they draw, and compute nothing.

The sidebar's panels follow the user's steps: next_step.py, geometry.py (with design.py), phantom.py, projections.py,
runs.py, reconstruction.py, event_set.py. What they have in common is in sidebar.py.

- A panel is a class `MPHDRR_PT_...` in the file of its subject, found without a list; its label follows from its name, and
  its docstring is its tooltip. Its place is `bl_order` (`addon/blender/ids.py`).
- A setting of projections or reconstructions appears by itself; which panel shows it is decided by `_MAIN` and `_PHYSICS`
  (projections.py, reconstruction.py); what it shows for a number that is not given is `unset` of its `Setting`.
- Each operator has a line in a menu of menus.py; `tests/blender/test_words.py` misses those without.
"""
