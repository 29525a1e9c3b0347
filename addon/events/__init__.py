"""Event Set panel: recipes tried on the phantom in the scene, event sets made, and events opened in the scene.

`event_sets.try_event_job`, `event_sets.make_set_job` and `event_sets.open_event_job` are the panel's jobs;
`event_notes.recipe_note` and `event_notes.set_note` describe a recipe and a set in a line.

A setting of event sets belongs to `core/events/recipe.py`: a job here needs a change only if its value cannot be a
phantom's setting, as the factor of activity in `_store_phantom`.

The panel's notes are read by `_read_recipe` and `_read_set` of event_notes.py, in a thread.
"""
