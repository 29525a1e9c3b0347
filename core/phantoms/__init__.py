"""Phantoms: solid shapes with known activity and attenuation, voxelised on any grid or integrated along lines exactly.

`Phantom` (`phantom.py`) is the base class of all kinds; `ShapePhantom` takes a list of shapes, `read_phantom`
(`language.py`) reads one from a TOML file. `paint_voxels` and `line_integrals` (`painting.py`) do the numerical work.

A new kind of phantom is a frozen dataclass in a file of its own, derived from `Phantom`. Its fields are made by
`setting`, `count` and `choice` (`settings.py`), its property `shapes` lists the shapes from bottom to top. A line in
`KINDS` (`kinds.py`) adds it to the command line, to recipes and to Blender; a line in `core/__init__.py` makes it public.
Choices that scenes keep have numbers, which tests/blender/test_earlier_versions.py lists (`FROZEN`): add the new kind
there. A new shape is a class derived from `Shape` (`shapes.py`) and a name in `SHAPES` (`language.py`).
"""
