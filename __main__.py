"""``python -m mphdrr``: the command line."""

from .addon.cli import program

program()
