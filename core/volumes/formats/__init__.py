"""Volumes in files.

A format is a module here with ``read(path) -> Contents`` and, where it is written too, ``write(volume, path)``. `volume_io`
chooses among them by the file's name.
"""
