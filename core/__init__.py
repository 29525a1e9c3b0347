"""mphDRR without Blender: geometry, phantoms, projections and exports of multi-pinhole scanners.

Everything imported here is the public interface. Arguments that cannot be used raise `InputError`.

>>> import mphdrr.core as mph
>>> system = mph.read_system("dc-spect-80.xlsx")
>>> views = system.views(shape=(256, 256))
>>> grid = mph.Grid.centered((128, 128, 128), 1.0)
>>> images = mph.Projector(grid, views)(mph.DerenzoPhantom(40, (8, 6, 5, 4, 3, 2), 40).voxelize(grid))

Each folder is a room, whose docstring says what it is for and how to add to it; docs/structure.md says which rooms it may
import. A public name is a line below. Files of this folder that all rooms use:

- errors.py: `InputError`, `InputWarning`, and `needing` around the import of a package that may be
  missing; in Blender it refers to docs/first-steps.md, which says how packages get there.
- files.py: the only file that writes files, by `replacing`, `new_folder` or `write_bytes`; hdf5.py: sealed HDF5 files.
- validation.py, arrays.py (types of arrays), memory.py, progress.py, recording.py, cache.py.
- scanner_kinds.py and method_files.py join rooms: the kinds of scanners, and of files that are methods.
"""

from typing import TYPE_CHECKING

from . import method_files as method_files  # enters its rows into the registry of `reconstruction`
from .lazy import public

if TYPE_CHECKING:
    from . import design, events, learning
    from .design.calibration import Calibration, calibrate
    from .design.point_images import point_images
    from .errors import InputError, InputWarning
    from .exchange import read_geometry, write_geometry
    from .geometry.checks import GeometryReport, check_geometry
    from .geometry.design_formulas import collimator_length, roi_radius_seen
    from .geometry.frames import euler_pose
    from .geometry.generators import ellipse_rings, plate_rings, regular_polygon
    from .geometry.grid import Grid
    from .geometry.parallel_views import parallel_views
    from .geometry.presets import c_arm_views, pinhole_views
    from .geometry.ring_fits import RingFit, fit_rings, ring_order
    from .geometry.system import PinholeSystem
    from .geometry.views import Views
    from .perspective.backprojection import backproject, views_that_see
    from .perspective.coordinates import line_through, transform_lines, transform_points
    from .perspective.correspondence import Correspondences, find_correspondences, samples_along_rays
    from .perspective.epipolar import epipolar_lines, epipolar_segments, epipole, essential_matrix, fundamental_matrix
    from .perspective.perspective_grid import PerspectiveGrid, depth_ranges, perspective_grids
    from .perspective.predictions import predict_views, prediction_errors, spread_along_rays
    from .perspective.resampling import camera_to_camera, from_perspective, to_perspective
    from .perspective.triangulation import MarkerFit, fit_marker, triangulate
    from .perspective.view_rays import intrinsic_matrices, points_at_depths, project_points, view_frames
    from .phantoms.defrise import DefrisePhantom
    from .phantoms.derenzo import DerenzoPhantom, DerenzoRods
    from .phantoms.jaszczak import JaszczakPhantom
    from .phantoms.language import read_phantom, write_phantom
    from .phantoms.mixture import MixturePhantom
    from .phantoms.nema import NemaBody
    from .phantoms.phantom import Phantom, PhantomMesh, ShapePhantom
    from .phantoms.points import PointGrid
    from .phantoms.random import random_pose
    from .phantoms.shapes import Box, Capsule, Cone, Cylinder, Ellipsoid, Shape, Sphere
    from .phantoms.shepp_logan import SheppLogan
    from .phantoms.torso import CardiacTorso
    from .physics.ct_numbers import diffdrr_density, hu_to_mu, mu_to_hu
    from .physics.dead_time import dead_time_corrected, dead_time_counts
    from .physics.energy_window import energy_window_scatter
    from .physics.flood import FloodEfficiency, flood_efficiency
    from .physics.isotopes import ISOTOPES, Isotope, isotope
    from .physics.maps import completeness_map, modules_map, resolution_map, sensitivity_map
    from .physics.materials import MATERIALS, Material, attenuation
    from .physics.noise import sample_counts
    from .physics.optics import Optics
    from .physics.performance import (
        ModulePerformance,
        isocentre_performance,
        magnification,
        resolution,
        seen,
        sensitivity,
    )
    from .physics.sampling import sampling_gaps
    from .progress import Cancelled, Progress
    from .projector import (
        Emission,
        FrameProjector,
        GeometryGradient,
        InverseSquareSum,
        Projector,
        Transmission,
        geometry_gradient,
        intensity,
        trace_rays,
    )
    from .reconstruction.adapters import deepinv_physics, parallelproj_operator, pytomography_matrix, scipy_operator
    from .reconstruction.bsrem import bsrem
    from .reconstruction.expectation import mlem, osem
    from .reconstruction.fbp import fbp
    from .reconstruction.fdk import fdk
    from .reconstruction.files import read_reconstruction, write_reconstruction
    from .reconstruction.least_squares import cgls, sirt
    from .reconstruction.loop import IterativeOptions
    from .reconstruction.ostr import ostr
    from .reconstruction.priors import Prior, Quadratic, RelativeDifference, TotalVariation
    from .reconstruction.result import Reconstruction
    from .reconstruction.scores.derenzo import DerenzoScore, DerenzoSector, RodProfile, derenzo_score
    from .reconstruction.scores.images import BiasAndDeviation, bias_and_deviation, contrast_to_noise, nrmse, psnr, ssim
    from .reconstruction.scores.nema import NemaScore, NemaSphere, nema_score
    from .reconstruction.scores.summary import VolumeScore, score_volume
    from .reconstruction.stopping import StoppingRule, StopWhen
    from .reconstruction.tv import tv
    from .runs.backprojecting import backproject_run, run_line_integrals
    from .runs.dicom_counts import write_counts
    from .runs.files import read_run, write_run
    from .runs.frame_files import read_counts
    from .runs.measured import counts_run
    from .runs.mosaic import as_seen, mosaic
    from .runs.orientations import ORIENTATIONS
    from .runs.projecting import project_run
    from .runs.recipe import Recipe, read_recipe, write_recipe
    from .runs.reconstructing import reconstruct_run
    from .runs.run import ProjectionRun
    from .runs.run_recipe import projector_of_run, run_recipe
    from .runs.scatter_windows import ScatterWindows
    from .scatter.images import ScatterImages, scatter_images
    from .system_source import SystemSource
    from .volumes.meshes.mesh import Mesh, read_mesh, write_mesh
    from .volumes.meshes.surface import volume_to_mesh
    from .volumes.meshes.voxelization import voxelize_mesh
    from .volumes.rearranging import canonical, centered, crop, crop_to_box, pad, split_labels
    from .volumes.resampling import resample
    from .volumes.volume import Volume
    from .volumes.volume_files import read_volume, write_volume
    from .workbook.column_map import ColumnMap, MappedColumn, MappedTable
    from .workbook.draft import ColumnMapDraft, draft_column_map, preview_workbook
    from .workbook.reader import kinds_in, read_scanner, read_system
    from .workbook.writer import WrittenWorkbook, write_system
    from .xray.arrangements import xray_arc, xray_ring
    from .xray.checks import find_in_room
    from .xray.decomposition import correct_beam_hardening, decompose, decompose_images, virtual_monoenergetic
    from .xray.detectors import EnergyIntegrator, PhotonCounter
    from .xray.dose import absorbed_dose, absorbed_dose_rate, isocentre_kerma
    from .xray.motion import Motion, MotionFinder, find_change, find_motion
    from .xray.scan import SpectralScan
    from .xray.scatter import XrayScatter, xray_scatter
    from .xray.spectra import Spectrum, tube_spectrum
    from .xray.spectral import SpectralTransmission, panel_blur, water_and_bone
    from .xray.system import XraySystem

__getattr__, __dir__, __all__ = public(__name__)
