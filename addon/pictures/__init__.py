"""Projections as pictures: Blender images with exact numbers and colours, the mosaic, and planes in the scene.

`images.make_pictures` makes the pictures of a run in a worker thread, `images.store_images` puts them into the .blend,
`planes.show_planes` hangs them in front of the pinholes. `tiles.py` converts between positions in a picture and pixels of
a projection, and `recoloring.py` follows the settings of `display_properties.py`.

A colour ramp or a scale is added in `core/runs/display.py`; the panel's words for scales are in `display_properties.py`.
"""
