"""Runs: images of all modules with everything that made them; made by a recipe, measured, kept in files, reconstructed.

- `run_recipe.run_recipe` makes the runs of a recipe (`recipe.Recipe`); `measured.counts_run` makes one of measured counts.
- `files.read_run` and `files.write_run` read and write a run (`run.ProjectionRun`).
- `reconstructing.reconstruct_run` reconstructs a run's volume with the run's own model.

To add a setting, add a row to `_DECLARED` in `settings.py`; options, panels, recipe files and records follow. A physics
preset is a row of `presets.py`, a file format of measured counts a reader in `frame_files.py`.
"""

FORMATS = (".h5", ".hdf5", ".npz", ".pt")
"""Endings of run files."""
