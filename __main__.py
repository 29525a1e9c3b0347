"""``python -m mphdrr``: the command line."""

import sys

from .addon.cli import main

sys.exit(main())
