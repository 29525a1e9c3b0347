"""mphDRR's version, and a checksum that tells builds of one version apart.

The package and its documentation take the version from here. Blender's manifest and CITATION.cff repeat it; a test compares
them.
"""

import hashlib
from functools import cache
from pathlib import Path

VERSION = "0.2.0"


@cache
def build() -> str:
    """Return twelve hexadecimal digits of the SHA-256 of all files that this package computes with."""
    root, digest = Path(__file__).parent, hashlib.sha256()
    files = (path for path in root.rglob("*") if path.suffix in (".py", ".c", ".h", ".txt", ".so", ".dylib", ".dll"))
    for path in sorted(files, key=lambda path: path.relative_to(root).as_posix()):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]
