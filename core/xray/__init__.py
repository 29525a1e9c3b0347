"""X rays: sources and panels as a kind of scanner, tube spectra, detectors, materials from counts; absorbed dose.

Entry points: `XraySystem` (sources with panels; `xray_arc` and `xray_ring` build them), `SpectralScan` (images of a volume,
the model "spectral" of recipes), `xray_scatter` (scattered photons in the panels), `decompose` (materials from counts),
`find_motion` (motion since a reference volume) and `absorbed_dose_rate` (dose of an activity).

- A detector is a class with a method ``response`` in detectors.py, its choice in `SpectralScan._detector` (scan.py) and
  its word in ``model.panel`` of `core/runs/settings.py`. Counts of a run and their line integrals are made by
  `SpectralScan`.
- A column of the sheet X-ray is a row of `XRAY_COLUMNS` in system.py.
- An arrangement of sources is a function in arrangements.py; its options are in `core/cli/geometry/generate.py`, its
  settings in the window in `operators/xray.py`.
- The tube spectra are a table that `tools/tube_spectra.py` makes with SpekPy.
- A mechanical check is a `Finding` and its search in checks.py (`find_in_room`).
"""
