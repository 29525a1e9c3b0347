"""mphDRR's version, which package and documentation take from here, and what tells builds of one version apart.

Blender's manifest and CITATION.cff repeat it; a test compares them.
"""

import hashlib
from functools import cache
from pathlib import Path

VERSION = "0.2.0"


@cache
def build() -> str:
    """Twelve digits made of all that this package computes with: of two builds that are not alike, they differ."""
    root, found = Path(__file__).parent, hashlib.sha256()
    files = (path for path in root.rglob("*") if path.suffix in (".py", ".c", ".h", ".txt", ".so", ".dylib", ".dll"))
    for path in sorted(files, key=lambda path: path.relative_to(root).as_posix()):
        found.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return found.hexdigest()[:12]
