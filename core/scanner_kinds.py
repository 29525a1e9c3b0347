"""The complete table of the kinds of scanners, by name; code that reads a kind's name imports the table from here."""

from .geometry.scanner import SCANNERS as SCANNERS
from .geometry.scanner import Scanner
from .geometry.system import PinholeSystem as PinholeSystem
from .validation import one_of
from .xray.system import XraySystem as XraySystem


def scanner_kind(name: str) -> type[Scanner]:
    """Return the class of the kind of scanner with this name; raise `InputError` if there is none."""
    one_of(name, SCANNERS, "kind of scanner")
    return SCANNERS[name]
