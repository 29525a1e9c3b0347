"""Figures: pages drawn both as pixels and as SVG, and the table of the kinds of figures.

Entry points: `kinds.KINDS` (all kinds, for command line and menus), `page.Page` (a page with lines, areas, text and
pictures, written as PNG or SVG), `reconstructions.draw` and `scores.draw` (figures of results).

To add a kind of figure, add a line to `KINDS` in kinds.py: a function ``draw(page, subject)``, which uses `parts` for
headings, axes and colour bars and `FigureSubject` for what is to be drawn; or, if Blender renders it, a `Studio`. Figures
need no plotting library.
"""
