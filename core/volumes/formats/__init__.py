"""Formats of volumes in files.

Each format is a module, such as `nifti`, `dicom` and `hdf5`, with ``read(path) -> VolumeFileContents`` and, if the format is
also written, ``write(volume, path)``. `core.volumes.volume_files` chooses the module by the ending of the file's name.

A new format is a module here, whose `read` raises `InputError` with one line for everything that it cannot read correctly,
and its endings in `_READERS` and `_WRITERS` of `volume_files.py`. `contents.py` has the checks that all readers share.
"""
