"""Linear attenuation coefficients of tissues at Tc-99m's 140.5 keV, 1/mm.

Density times the total mass attenuation coefficient from W. T. Elam et al., Radiation Physics and Chemistry 63 (2002)
121-128 (as in XrayDB 4), of the compositions in ICRU Report 44 (1989) and, of the vertebrae, ICRU Report 46 (1992).
Water's is in `isotopes`.
"""

from __future__ import annotations

SOFT_TISSUE_MU = 0.0161
"""Soft tissue, 1.06 g/cm^3."""
LUNG_MU = 0.00396
"""Lung, inflated, 0.26 g/cm^3."""
VERTEBRA_MU = 0.0203
"""Vertebral column with its cartilage (D6, L3), 1.33 g/cm^3."""
PMMA_MU = 0.0177
"""Poly(methyl methacrylate), 1.19 g/cm^3: what phantoms are made of."""
