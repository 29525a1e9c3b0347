"""Models of what a pixel measures: which rays it takes, or which pinhole response, and with which weights.

Entry points: `model.Transmission` (radiographs), `emission.Emission` (SPECT counts), and their base class `model.Model`.

To add a model, derive a class from `Model` in a file here: `beams` yields the rays of a view with their weights, or
`by_depth` returns a `PinholeOperator` in their place; `parts` are the models of a sum. `Projector` asks for no more.
"""
