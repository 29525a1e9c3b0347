"""The Blender side of mphDRR: rooms of plain functions that read and write the scene; operators and panels call them.

A room may import those before it: `blender`, `volumes`, `phantoms`, `scanner`, `pictures`, `runs`, then `perspective`,
`reconstruction`, `figures`, `events` and `cli`. Files of this folder join rooms: `registration.py` registers everything,
`properties.py` has the scene's property groups, `next_step.py` proposes the next step.

To add a task, write a function of a room, an operator that calls it, and a line in `panels/menus.py`. This file imports
nothing, so that `mphdrr.addon.blender.ids` can be read without Blender.
"""
