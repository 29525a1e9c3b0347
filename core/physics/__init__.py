"""Physics of detection: isotopes, materials, aperture and crystal, sensitivity, resolution, dead time and noise.

`Optics` (optics.py) is the one sensitivity law, from which performance, maps and projections follow; `sensitivity` and
`resolution` (performance.py) evaluate it at points, `sensitivity_map` and others (maps.py) on a grid.

- An isotope is a line in isotopes.txt, a material a line in materials.txt; names and help texts follow.
- A map is a function in maps.py that returns a `Volume`, with a line in `MAPS` and a number in `addon/blender/choices.py`.
- A new effect in the hole or the crystal is a field of `Optics` and a factor in `Optics.counted`; as a setting of runs it
  also needs a line in `core/runs/settings.py`.

Lengths are in mm, attenuation coefficients in 1/mm, energies in keV, times in s.
"""
