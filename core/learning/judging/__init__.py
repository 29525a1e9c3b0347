"""The judge: scores with intervals of any method of a name, baselines and networks alike, on sets of events.

A method is a function of a `ProjectionRun` that gives a `Volume`; the judge knows nothing else of it, and imports no torch.
"""
