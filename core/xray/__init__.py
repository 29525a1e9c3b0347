"""X rays: sources and panels as a kind of scanner, tube spectra, detectors, materials from counts; absorbed dose.

Entry points: `XraySystem` (sources with panels; `xray_arc` and `xray_ring` build them), `SpectralScan` (images of a volume,
the model "spectral" of recipes), `decompose` (materials from counts), `find_motion` (motion since a reference volume) and
`absorbed_dose_rate` (dose of an activity).

To add a detector, write a class with a method ``response`` as in detectors.py and choose it in `SpectralScan._detector`. To
add a column of the sheet X-ray, add a row to `XRAY_COLUMNS` in system.py. To add an isotope for dose, add a line to
decays.txt. To add a mechanical check, add a `Finding` and its search to checks.py.
"""
