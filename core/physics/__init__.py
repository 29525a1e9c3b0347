"""Physics of detection: isotopes, materials, aperture and crystal, sensitivity, resolution, dead time and noise.

`Optics` (optics.py) is the one sensitivity law, from which performance, maps and projections follow (`counted` of a
point, `pixel_weights` of a pixel); `sensitivity` and `resolution` (performance.py) evaluate it at points,
`sensitivity_map` and others (maps.py) on a grid.

- An isotope is a line in isotopes.txt, whose radiations `tools/photon_lines.py` writes from name and half-life, a material
  a line in materials.txt (and its name in `APERTURES` or `CRYSTALS` of materials.py, if it is offered for these); names,
  menus and help texts follow. tests/core/test_emission.py compares each isotope with ICRP 107, and wants its numbers.
- A noise model is a function like `draw_poisson` and a row of `NOISE_MODELS` (noise.py); with a second row the choice is
  the setting ``noise.model`` of recipes, commands and event sets; the window's panel draws Poisson noise.
- A map is a function in maps.py that returns a `Volume`, with a line in `MAPS` and a number in
  `addon/blender/choices.py`.
- A new effect in the hole or the crystal is a field of `Optics` and a factor in `Optics.counted`; as a setting of runs it
  also needs a line in `core/runs/settings.py`.
- Which photons a window counts, and scatter from other windows, is energy_window.py (`counted_lines`, `peak_shares`,
  `energy_window_scatter`).

Lengths are in mm, attenuation coefficients in 1/mm, energies in keV, times in s.
"""
