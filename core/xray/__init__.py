"""A second imaging chain: X-ray sources and panels as a scanner, spectra, materials; and absorbed dose.

`system` is `XraySystem` and its columns, `arrangements` makes arcs and rings of sources, `checks` finds what stands in the
way of cones, panels and the patient. `spectra` has what a tube sends out, `detectors` what of it is counted, `spectral` both
and materials between them. From its counts `decomposition` finds the materials. `dose` is that of activity; `coefficients`
has what the others look up.
"""
