"""Table of the kinds of phantoms; command line, recipes and Blender follow from it and from the classes' fields.

A new kind is a file with its dataclass, whose fields are made by `settings.setting`, `count` and `choice`, and a line here.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from .defrise import DefrisePhantom
from .derenzo import DerenzoPhantom
from .jaszczak import JaszczakPhantom
from .mixture import MixturePhantom
from .nema import NemaBody
from .points import PointGrid
from .shepp_logan import SheppLogan
from .torso import CardiacTorso


class PhantomKind(NamedTuple):
    """Kind of phantom: its class, and its names and texts for users."""

    name: str
    """Name on the command line and in recipes."""
    phantom: Any
    """Class of the phantom, a dataclass derived from `Phantom`."""
    label: str
    """Name in Blender's menus."""
    summary: str
    """Noun phrase for help texts and tooltips, with its article."""
    example: str = ""
    """Options of the example in the command's help."""
    usual: Mapping[str, float] = MappingProxyType({})
    """Initial values in Blender and in recipes that differ from the class's defaults, by field."""


_HOT = {"activity": 100.0}
KINDS = (
    PhantomKind("derenzo", DerenzoPhantom, "Derenzo", "a Derenzo phantom: sectors of hot rods", "--rods 8 6 5 4 3 2", _HOT),
    PhantomKind("nema", NemaBody, "NEMA Body", "the NEMA (IEC) body phantom: six spheres", "--sphere-activity 40"),
    PhantomKind("jaszczak", JaszczakPhantom, "Jaszczak", "a Jaszczak phantom: rods and spheres", "--activity 50"),
    PhantomKind("defrise", DefrisePhantom, "Defrise", "a Defrise phantom: hot disks", "--disks 7 --spacing-of-disks 12"),
    PhantomKind("shepp-logan", SheppLogan, "Shepp-Logan Head", "the 3-D Shepp-Logan head", "--contrast original"),
    PhantomKind("points", PointGrid, "Point Grid", "a grid of point sources", "--counts 3 3 3 --spacing-of-points 30 30 30"),
    PhantomKind("mixture", MixturePhantom, "Mixture", "random shapes, different for each seed", "--number 12"),
    PhantomKind("torso", CardiacTorso, "Cardiac Torso", "a cardiac torso",
                "--defect-severity 0.5 --defect-angle-degrees 90"),
)  # fmt: skip
