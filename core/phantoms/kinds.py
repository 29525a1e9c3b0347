"""The kinds of phantoms that are made from a few numbers: one table for the command line and for Blender."""

from __future__ import annotations

from typing import Any, NamedTuple

from .defrise import DefrisePhantom
from .derenzo import DerenzoPhantom
from .jaszczak import JaszczakPhantom
from .nema import NemaBody
from .points import PointGrid
from .shepp_logan import SheppLogan
from .torso import CardiacTorso


class Kind(NamedTuple):
    """One kind of phantom.

    Attributes
    ----------
    name : str
        On the command line.
    phantom : type
        Its class, a dataclass whose fields are made by `settings.setting`, `count` and `choice`.
    label : str
        In menus.
    summary : str
        What it is, for help.
    """

    name: str
    phantom: Any
    label: str
    summary: str


# Saved scenes hold a kind by its place in this table: add new ones at its end.
KINDS = (
    Kind("derenzo", DerenzoPhantom, "Derenzo", "a Derenzo phantom: six sectors of hot rods"),
    Kind("nema", NemaBody, "NEMA Body", "the NEMA (IEC) body phantom: six spheres"),
    Kind("jaszczak", JaszczakPhantom, "Jaszczak", "a Jaszczak phantom: rods and spheres"),
    Kind("defrise", DefrisePhantom, "Defrise", "a Defrise phantom: hot disks"),
    Kind("shepp-logan", SheppLogan, "Shepp-Logan Head", "the 3-D Shepp-Logan head"),
    Kind("points", PointGrid, "Point Grid", "a grid of point sources"),
    Kind("torso", CardiacTorso, "Cardiac Torso", "a cardiac torso"),
)
