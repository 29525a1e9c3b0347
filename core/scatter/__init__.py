"""Photons that scatter in a body before a module sees them.

Entry point: `scatter_images`. `body` makes the densities of materials from CT numbers or mu; `histories` calls the C kernels
that follow photons and look at their collisions (docs/scatter.md); `images` turns what modules see into images, by the
projector.
"""
