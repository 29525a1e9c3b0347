"""X rays: spectra of tubes, counts of spectral detectors, what they say of materials; and absorbed dose.

`spectra` has what a tube sends out, `detectors` what of it is counted, `spectral` both and materials between them. From
its counts `decomposition` finds the materials. `dose` is that of activity; `coefficients` has what the others look up.
"""
