"""Figures that Blender renders: the scanner and a volume in a scene of their own, and studio light.

`figures.figure_job` writes a figure or an animation of the scene, `figures.draw_figure` one of a subject without a scene;
`studio.light` lights the user's scene.

A kind of figure is a line of `KINDS` in `core/figures/kinds.py`; a rendered one names its view there (modules, rays,
volume, lens), which `stage.FigureScene` follows, and an animation its motion (`FigureScene.moment`).

Labels are `_label` of figures.py, Cycles and MP4 engine.py, the light of pictures and of a new scene `_SUNS` of
studio.py.
"""
