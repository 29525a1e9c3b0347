"""mphDRR without Blender: geometry, phantoms, projections and exports of multi-pinhole scanners.

>>> import mphdrr.core as mph
>>> system = mph.read_system("dc-spect-80.xlsx")
>>> views = system.views(shape=(256, 256))
>>> grid = mph.Grid.centered((128, 128, 128), 1.0)
>>> images = mph.Projector(grid, views)(mph.DerenzoPhantom(40, (8, 6, 5, 4, 3, 2), 40).voxelize(grid))
"""

from __future__ import annotations

from .design import collimator_length
from .errors import InputError, InputWarning
from .export import read_run, write_run
from .frames import euler_pose
from .grid import Grid
from .isotopes import ISOTOPES, Isotope, isotope
from .mosaic import as_seen, mosaic
from .noise import sample_counts
from .phantoms.defrise import DefrisePhantom
from .phantoms.derenzo import DerenzoPhantom, DerenzoRods
from .phantoms.jaszczak import JaszczakPhantom
from .phantoms.language import read_phantom, write_phantom
from .phantoms.nema import NemaBody
from .phantoms.phantom import Phantom, PhantomMesh, ShapePhantom
from .phantoms.points import PointGrid
from .phantoms.random import random_pose
from .phantoms.shapes import Box, Capsule, Cone, Cylinder, Ellipsoid, Shape, Sphere
from .phantoms.shepp_logan import SheppLogan
from .phantoms.torso import CardiacTorso
from .presets import c_arm_views, pinhole_views
from .progress import Cancelled, Progress
from .project import project_run
from .projector import Emission, InverseSquareSum, Projector, Transmission, intensity, trace_rays
from .run import ProjectionRun
from .system import PinholeSystem
from .views import Views
from .volume import Volume
from .volume_io import read_volume, write_volume
from .workbook import SystemSource, read_system

__all__ = [
    "ISOTOPES",
    "Box",
    "Cancelled",
    "Capsule",
    "CardiacTorso",
    "Cone",
    "Cylinder",
    "DefrisePhantom",
    "DerenzoPhantom",
    "DerenzoRods",
    "Ellipsoid",
    "Emission",
    "Grid",
    "InputError",
    "InputWarning",
    "InverseSquareSum",
    "Isotope",
    "JaszczakPhantom",
    "NemaBody",
    "Phantom",
    "PhantomMesh",
    "PinholeSystem",
    "PointGrid",
    "Progress",
    "ProjectionRun",
    "Projector",
    "Shape",
    "ShapePhantom",
    "SheppLogan",
    "Sphere",
    "SystemSource",
    "Transmission",
    "Views",
    "Volume",
    "as_seen",
    "c_arm_views",
    "collimator_length",
    "euler_pose",
    "intensity",
    "isotope",
    "mosaic",
    "pinhole_views",
    "project_run",
    "random_pose",
    "read_phantom",
    "read_run",
    "read_system",
    "read_volume",
    "sample_counts",
    "trace_rays",
    "write_phantom",
    "write_run",
    "write_volume",
]
