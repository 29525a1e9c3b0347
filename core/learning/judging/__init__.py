"""Judge of reconstruction methods: scores with confidence intervals, for networks and tuned baselines alike.

A method is a function from a `ProjectionRun` to a `Volume`; the judge knows nothing else of it, and imports no torch. Entry
points: `judge.judge` (all methods on all tests, resumable), `recipe.read_judge_recipe`, `methods.JudgedMethod` (a method
with its name), `sets.set_text` (recipes of the event sets).

To add a score, add a function to `SCORINGS` in scoring.py, its summary over events to summary.py, and its column to
`_COLUMNS` in report.py. To add a baseline, extend `Family.volumes` in methods.py and `JudgeRecipe.families` in recipe.py.
"""
