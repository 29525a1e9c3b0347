"""Runs: images of all modules with everything that made them; made by a recipe, measured, kept in files, reconstructed.

- `run_recipe.run_recipe` makes the runs of a recipe (`recipe.Recipe`); `measured.counts_run` makes one of measured
  counts.
- `files.read_run` and `files.write_run` read and write a run (`run.ProjectionRun`).
- `reconstructing.reconstruct_run` reconstructs a run's volume with the run's own model.

To add a setting, add a row to `_DECLARED` in settings.py; options, panels, recipe files, records and event sets follow.

- A setting ``model.…`` is also an argument of that name of the model's class (`core/models/emission.py`); one of hole,
  edge, cone or crystal is a field of `Optics` as well. What needs rays stands in `Emission.is_by_depth`, what presets
  decide in `_RESET` (presets.py). Settings of the detector and the backend are passed on in run_recipe.py.
- Counts besides the volume's are the model's background, from `recipe_model` (run_recipe.py). What is not linear in the
  volume, as dead time, is no part of a model: `Imaging` (projecting.py) applies it to a run's images, and counting.py
  makes it an efficiency of the run's projector.
- A setting ``reconstruction.…`` is used in reconstructing.py; the arguments of methods and priors are declared where
  these are (`core.reconstruction`).

`Imaging` is the one route from a volume to images, with the same warnings, of runs, reconstructions and event sets. A
preset is a row of `_ROWS` in presets.py. A file format of measured counts is a reader, such as interfile.py, that returns
`FileFrames` with what the file says of its frames, and its endings in `_READERS` of frame_files.py; warnings about frames
are `warn_of_frames` of frame_checks.py. Pictures are laid out by mosaic.py and coloured by display.py.
"""

FORMATS = (".h5", ".hdf5", ".npz", ".pt")
"""Endings of run files."""
EXPORT_FORMATS = (*FORMATS, ".dcm")
"""Endings of the files that a run is written to; .dcm holds its counts alone."""
