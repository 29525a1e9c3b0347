"""Recipes: the settings of a job, their values, and the TOML files that hold them.

Higher layers declare their recipes with this package: `runs` the recipe of projections, `events` that of event sets,
`learning` those of training and of the judge, `design` those of designs and calibrations.

- `settings.Setting` declares one setting: its key, type, default, limits, words and texts.
- `values.Values` holds the checked values of settings; a recipe is a class derived from it.
- `tables` reads the tables of a TOML file into values by key; `toml` reads and writes TOML itself.

To add a setting, add a row to the table of its recipe, such as `_DECLARED` in `core/runs/settings.py`.
"""
