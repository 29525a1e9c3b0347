"""Formats of run files, by their names' endings; what imports nothing can ask for them."""

FORMATS = (".h5", ".hdf5", ".npz", ".pt")
