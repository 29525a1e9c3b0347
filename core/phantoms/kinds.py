"""The kinds of phantoms that are made from a few numbers: one table for the command line and for Blender."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
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
    usual : mapping
        What scenes begin with where that is not the class's default.
    """

    name: str
    phantom: Any
    label: str
    summary: str
    usual: Mapping[str, float] = MappingProxyType({})


KINDS = (
    Kind("derenzo", DerenzoPhantom, "Derenzo", "a Derenzo phantom: six sectors of hot rods", {"activity": 100.0}),
    Kind("nema", NemaBody, "NEMA Body", "the NEMA (IEC) body phantom: six spheres"),
    Kind("jaszczak", JaszczakPhantom, "Jaszczak", "a Jaszczak phantom: rods and spheres"),
    Kind("defrise", DefrisePhantom, "Defrise", "a Defrise phantom: hot disks"),
    Kind("shepp-logan", SheppLogan, "Shepp-Logan Head", "the 3-D Shepp-Logan head"),
    Kind("points", PointGrid, "Point Grid", "a grid of point sources"),
    Kind("torso", CardiacTorso, "Cardiac Torso", "a cardiac torso"),
)
