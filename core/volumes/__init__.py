"""Volumes: arrays of voxels on a grid with a quantity, their files, their resampling, and meshes of and for them.

`Volume` (`volume.py`) holds the values; `read_volume` and `write_volume` (`volume_files.py`) choose the file format by
the name's ending; `resample` (`resampling.py`) and `crop`, `pad`, `canonical` (`rearranging.py`) make new volumes.

A new file format is a module in `formats` and its endings in `_READERS` and `_WRITERS` (`volume_files.py`): command line,
file browsers and dropped files follow. A new quantity is a line with its unit in `UNITS` (`volume.py`). Where slices of a
picture lie, and the value of its brightest colour, is `sights.py`.
"""
