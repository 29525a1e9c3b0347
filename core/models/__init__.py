"""Models of what a pixel measures: which rays it takes, or which pinhole response, and with which weights.

Entry points: `model.Transmission` (radiographs), `emission.Emission` (SPECT counts), and their base class `model.Model`.

To add a model, derive a class from `Model` in a file here: `beams` yields the rays of a view with their weights, or
`by_depth` returns a `PinholeOperator` in their place; `parts` are the models of a sum, as those of several photon lines
(photon_lines.py). `Projector` asks for no more. Photons through plates and walls, and which neighbours matter, are
wall_penetration.py (`Solids.attenuation`, `models_with_walls`).
"""
