"""One file per task that a user asks for: read the properties, call `addon` and `core`, report.

An operator's `bl_idname` follows from its class's name (`ids.operator_name`), and so does its `bl_label` where it has no
other (`ids.label`); `registration.py` sets them.
"""
