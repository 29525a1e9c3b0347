"""Blender tools that know nothing of scanners: jobs, reports, files beside the .blend, properties made from settings.

`jobs.Job` is work that leaves the window alive, `jobs.JobOperator` the operator that does it, `reports.Reported` one that
acts at once. `storage.folder` holds the scene's large files, `setting_properties.make_properties` turns settings of core
into Blender's properties, and `updates.on_edit` calls what rebuilds or draws, by name.

To add a job, write a function of a higher room that returns a `Job`, and an operator that inherits from `JobOperator`.
To follow a new Blender version, change `compat.py` alone. A new choice of an enumeration needs no number in `choices.py`.

Facts of single files: core's messages are put into the window's words by `reports.in_window`; which files a volume has,
and what Save As and Collect Files bring along, is storage.py (`resume_file`, `file_references`); what waits until the
scene rests is timers.py; `core.progress.stages_of` has the words of a job's stages.
"""
