"""The scanner of the scene: modules and their parts, their reactions to edits, workbooks, and maps of the scanner.

`scanner.build_scanner` puts any `Scanner` of core into the scene, `scanner.read_scanner` reads it back in float64.
Handlers in `live_scanner.py` call `following.refresh`, which makes modules follow their values; `module_edits.py` adds,
removes and renumbers modules; `maps.map_job` and `optimising.optimize_job` are jobs.

A new kind of scanner is a class derived from `Scanner` in a room of core and a line of `core/scanner_kinds.py`: nothing
changes here. A typed column of a kind becomes a Blender property in `columns.py`; whatever only pinholes have is in
`pinholes.py`.

What follows a move stands at the head of live_scanner.py (handlers), following.py (values and shapes) and grabbing.py
(parts that take their module along). `module_values.read_modules` reads any kind of scanner; `cameras.py` sets what a
module's camera sees, framing.py the 3D view, sight_lines.py the lines of sight. Optimise is optimising.py, whose modules
change in `module_edits.set_modules`.
"""
