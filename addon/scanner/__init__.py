"""The scanner of the scene: modules and their parts, their reactions to edits, workbooks, and maps of the scanner.

`scanner.build_scanner` puts any `Scanner` of core into the scene, `scanner.read_scanner` reads it back in float64. Handlers
in `live_scanner.py` call `following.refresh`, which makes modules follow their values; `module_edits.py` adds, removes
and renumbers modules; `maps.map_job` and `optimising.optimize_job` are jobs.

A new kind of scanner is a class in `core/geometry` and a line of `core/scanner_kinds.py`: nothing changes here. A typed
column of a kind becomes a Blender property in `columns.py`; whatever only pinholes have is in `pinholes.py`.
"""
