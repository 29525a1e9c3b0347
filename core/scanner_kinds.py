"""The table of the kinds of scanners, complete: what reads a kind's name imports it from here."""

from .geometry.scanner import SCANNERS as SCANNERS
from .geometry.scanner import Scanner
from .geometry.system import PinholeSystem as PinholeSystem
from .validation import one_of
from .xray.system import XraySystem as XraySystem


def scanner_kind(name: str) -> type[Scanner]:
    """The class of a kind of scanner, or `InputError`."""
    one_of(name, SCANNERS, "kind of scanner")
    return SCANNERS[name]
