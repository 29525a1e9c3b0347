"""``python -m mphdrr``: the command line."""

import sys

from .addon.cli import main

if __name__ == "__main__":  # workers import it under another name
    sys.exit(main())
