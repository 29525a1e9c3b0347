"""Volumes of the scene: files of voxels, import, materials, looks, slices, and meshes made from volumes or into them.

`volumes.add_volume` puts a volume of core into the scene, `volumes.volume_from_object` reads it back exactly, and
`volumes.add_volume_job` does the former as a job. `volume_import.import_job` reads files.

To add a colour ramp or a look for the Asset Browser, add a line to `_LOOKS` in `volume_materials.py`; a look of the
Phantom panel is a line of `LOOKS` in `addon/phantoms/phantom_properties.py`, and `looks.py` draws it.

Colours and the unit that the window shows are `ramp` and `display_unit` (volume_materials.py): slices, colour bar and
surfaces follow; `item_ramp` reads colours as the user has edited them, `set_look_inputs` writes a look's inputs. Files
with other endings are read by `core/volumes/volume_files.py`; `operators/dropped_files.py` says which operator opens
which.
"""
