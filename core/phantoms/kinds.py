"""The kinds of phantoms, one line each; command line and Blender follow from this table and from the classes' fields.

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


class Kind(NamedTuple):
    """One kind of phantom."""

    name: str  # on the command line
    phantom: Any  # its class
    label: str  # in menus
    summary: str  # one line of help
    example: str = ""  # options on the command line
    usual: Mapping[str, float] = MappingProxyType({})  # settings where Blender does not begin with the class's default


_HOT = {"activity": 100.0}
KINDS = (
    Kind("derenzo", DerenzoPhantom, "Derenzo", "a Derenzo phantom: sectors of hot rods", "--rods 8 6 5 4 3 2", _HOT),
    Kind("nema", NemaBody, "NEMA Body", "the NEMA (IEC) body phantom: six spheres", "--sphere-activity 40"),
    Kind("jaszczak", JaszczakPhantom, "Jaszczak", "a Jaszczak phantom: rods and spheres", "--activity 50"),
    Kind("defrise", DefrisePhantom, "Defrise", "a Defrise phantom: hot disks", "--disks 7 --spacing-of-disks 12"),
    Kind("shepp-logan", SheppLogan, "Shepp-Logan Head", "the 3-D Shepp-Logan head", "--contrast original"),
    Kind("points", PointGrid, "Point Grid", "a grid of point sources", "--counts 3 3 3 --spacing-of-points 30 30 30"),
    Kind("mixture", MixturePhantom, "Mixture", "random shapes, other ones for each seed", "--number 12"),
    Kind("torso", CardiacTorso, "Cardiac Torso", "a cardiac torso", "--defect-severity 0.5 --defect-angle-degrees 90"),
)
