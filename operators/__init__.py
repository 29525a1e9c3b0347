"""One file per task that a user asks for: read the properties, call `addon` and `core`, report."""
