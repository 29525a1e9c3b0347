"""Formats of volumes in files.

Each format is a module with ``read(path) -> Contents`` and, if it is also written, ``write(volume, path)``.
`core.volumes.volume_files` chooses among them by the file's name.
"""
