"""Phantoms of the scene: volumes that keep the settings they were voxelized from, so that they can be voxelized again.

`phantoms.add_phantom_job` adds one, with an operator's settings or those of `phantom_properties.plain_settings`.
`phantoms.settings_of` returns a volume's settings, `live_phantoms.settings_changed` follows their edits, and
`volume_export.export_job` writes any volume to a file.

A new kind of phantom is a class in `core/phantoms` and a line of `KINDS` there: settings, operator and menu follow. To add
a look, add a line to `LOOKS` in `phantom_properties.py` and the way it is drawn to `addon/volumes/looks.py`.
"""
