"""Settings of a projection run, declared once.

`SETTINGS` is the only declaration: the options of ``mphdrr project``, the recipe files, the properties of Blender's panel
and operator, and the record in a run file follow from it. A new setting of a model is a line here and an argument of the
same name in the model's class.
"""

import dataclasses
import functools
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

from ..phantoms.kinds import KINDS
from ..phantoms.settings import setting_names
from ..physics.isotopes import ISOTOPES
from ..physics.materials import APERTURES, CRYSTALS
from ..physics.noise import NOISE_MODELS
from ..rays.backends import BACKENDS, OLD_NAMES
from ..recipes.settings import (
    Setting,
    UncheckedSetting,
    alternatives,
    choice_setting,
    default_setting,
    table_names,
    word_labels,
)
from ..reconstruction.method_files import METHOD_FILES
from ..reconstruction.methods import METHODS, argument_settings
from ..volumes.volume import LINE_INTEGRALS
from .frame_files import RAW_TYPES
from .orientations import ORIENTATIONS

_COUNTS = "model.kind=emission"
_XRAYS = "model.kind=spectral"
_PHOTONS = f"{_COUNTS} or {_XRAYS}"
_METHOD_OF_COUNTS = alternatives("reconstruction.method", [name for name, m in METHODS.items() if m.of_counts])
_RAYS = "model.kind=transmission or model.hole=rays or model.hole=point"
_FILE = "volume.file or volume.states"
_MADE = "no counts.files"
_SCATTER = "counts.lower_frames or counts.upper_frames"
_PHANTOM = ("no volume.file", "no volume.states", _MADE)
_PHANTOM_NUMBER = (*_PHANTOM, "no phantom.file", "no phantom.text")
_NO_PHANTOM = ("no phantom.kind", "no phantom.file", "no phantom.text")
_SERIES = "The DICOM series with this number, description or UID, where the folder holds several"
_AT_ENERGY = "Convert CT numbers to attenuation (1/mm) at this energy, or at an isotope's strongest line"
_ISOTOPES = word_labels(ISOTOPES, "Energy window 10 % around its strongest line")
_BY_NAME = "As it attenuates the isotope's photons"


_OF_MODULES = ", one number or one for each module that is used"
_ARGUMENTS = argument_settings((
    *("background", "scatter", "relaxation", "step_decay", "photons", "nonnegative"),
    *("prior", "weight", "gamma", "edge", "anatomy"),
))  # fmt: skip
"""Settings of the arguments of methods and priors, in the order of panels and recipe files; new arguments follow."""


_DECLARED = (
    Setting("system.file", str, None, "Geometry workbook (.xlsx, .xlsm)", is_path=True, option="--system"),
    Setting("system.kind", str, "pinhole", "Kind of the scanner, of a workbook that holds several", option="--scanner-kind"),
    Setting("system.columns", str, None, "Column map (.toml): the meaning of cells whose headings do not say it; "
            "geometry show --write-columns makes a draft", is_path=True),
    Setting("system.modules", str, None, "Numbers of the modules, such as 1-40 or 1-20,41", "all"),
    Setting("volume.file", str, None, "Volume, or folder of a DICOM series", "a phantom is made", is_path=True,
            needs=("no volume.states", _MADE, *_NO_PHANTOM), option="--volume"),
    Setting("volume.states", str, None, "Volumes of the states of a changing body, such as a beating heart: a run of each, "
            "as OUTPUT-1, OUTPUT-2 …", is_path=True, sizes=(), needs=("no volume.file", _MADE, *_NO_PHANTOM)),
    Setting("volume.object", str, None, "Name of the volume's object in a Blender scene", needs=_PHANTOM),
    Setting("volume.state", str, None, "State of the object's sequence", needs=("volume.object",)),
    Setting("volume.series", str, None, _SERIES, needs=("volume.file",)),
    Setting("volume.quantity", str, None, "Quantity of the volume's values", "that of the file; a file that names none "
            "holds activity for counts, mu for photons, else CT numbers", words=word_labels(LINE_INTEGRALS, ""),
            needs=(_FILE, "no volume.energy")),
    Setting("volume.energy", float, None, f"{_AT_ENERGY}; of spectral, at which the volume's mu holds", unit="keV",
            words=_ISOTOPES, above=0, needs=(f"{_FILE} or {_XRAYS}", "no model.kind=emission")),
    Setting("volume.center", bool, False, "Move the volume's centre to the isocentre, and other states and the "
            "attenuation with it", needs=(_FILE,)),
    Setting("phantom.kind", str, "derenzo", "Kind of the phantom", needs=_NO_PHANTOM[1:],
            words={kind.name: (kind.label, kind.summary) for kind in KINDS}, option="--phantom-kind"),
    Setting("phantom.file", str, None, "A phantom's shapes (.toml), or a kind of phantom", is_path=True,
            needs=("no phantom.kind", "no phantom.text"), option="--phantom"),
    Setting("phantom.text", str, None, "A phantom's shapes: the contents of such a file",
            needs=("no phantom.kind", "no phantom.file"), option="--phantom-text"),
    Setting("phantom.position", float, (0.0, 0.0, 0.0), "Centre of the phantom, x y z", unit="mm", sizes=(3,)),
    Setting("phantom.euler_degrees", float, (0.0, 0.0, 0.0), "Angles phi theta psi: psi about its own axis, then theta "
            "about y, then phi about z", unit="degrees", sizes=(3,)),
    Setting("phantom.matrix", list, None, "World-from-phantom matrix, 4 rows", "that of position and angles", unit="mm"),
    Setting("phantom.voxels", int, (256,), "Voxels along x y z, or one number for all", least=1, sizes=(1, 3)),
    Setting("phantom.spacing", float, None, "Voxel size, one or three", "so that the phantom fits", unit="mm", above=0,
            sizes=(1, 3)),
    Setting("phantom.turn_grid", bool, False, "Turn the grid with the phantom"),
    Setting("attenuation.file", str, None, "Attenuation coefficients, 1/mm, on any grid, or CT numbers (a DICOM folder, "
            "too); or a file of coefficients for each of the isotope's lines, by energy", "nothing attenuates", is_path=True,
            sizes=(), needs=(_COUNTS, "no attenuation.of_phantom"), option="--mu"),
    Setting("attenuation.object", str, None, "Name of the attenuation's object in a Blender scene",
            needs=(_COUNTS, "no attenuation.file", "no attenuation.of_phantom"), option="--mu-object"),
    Setting("attenuation.series", str, None, _SERIES, needs=("attenuation.file",), option="--mu-series"),
    Setting("attenuation.energy", float, None, _AT_ENERGY + "; lines: for each of the isotope's lines at its own",
            unit="keV", words={**_ISOTOPES, "lines": ("Lines", "Each of the isotope's lines at its own energy")}, above=0,
            needs=("attenuation.file",), option="--mu-energy"),
    Setting("attenuation.of_phantom", bool, False, "The phantom attenuates by its own coefficients",
            needs=(_COUNTS, *_PHANTOM, "no attenuation.file"), option="--phantom-mu"),
    Setting("counts.files", str, None, "Measured counts instead of a volume: files with a frame a module, of a real or "
            "another simulator's scanner (.npy, .npz, .h5, DICOM, .mhd, Interfile's .hdr, raw numbers)", is_path=True,
            sizes=(), needs=(_COUNTS, "no volume.file", "no volume.states", *_NO_PHANTOM), option="--counts"),
    Setting("counts.frames", str, None, "Numbers of the modules in the order of the frames, such as 1-80, 80-1 or 3,1,2; "
            "none for an unused frame, none*80 for 80 of them", option="--frames",
            needs=("no counts.frames_file",)),
    Setting("counts.frames_file", str, None, "Text file with these numbers", is_path=True, needs=("no counts.frames",)),
    Setting("counts.orientation", str, None, "Orientation of a frame, as a picture with row 0 at the top, on the crystal: "
            "the side from which it is seen, front (the pinhole) or back, and the module's axis at the top; one word, or "
            "one for each frame", words=ORIENTATIONS, sizes=(), unset="Not Said"),
    Setting("counts.expected", bool, False, "The numbers are expected counts, which may be fractions",
            label="Expected Means"),
    Setting("counts.dataset", str, None, "Name of the array in .npz and .h5", "the only one of three axes",
            label="Array"),
    Setting("counts.raw_shape", int, None, "Frames, rows and columns of a raw file", least=1, sizes=(3,)),
    Setting("counts.raw_type", str, None, "Type of a raw file's numbers", "the file is not raw",
            words=word_labels(RAW_TYPES, ""), unset="Not Said"),
    Setting("counts.raw_big_endian", bool, False, "The most significant byte of a raw file's numbers comes first",
            label="Big-Endian"),
    Setting("counts.lower_frames", str, None, "Frames of the energy window below the peak's, from which scatter is "
            "estimated: the modules' numbers, as in frames", label="Lower Window"),
    Setting("counts.upper_frames", str, None, "Frames of the energy window above the peak's, as lower_frames",
            label="Upper Window"),
    Setting("counts.window_widths", float, None, "Widths of the lower, the peak and the upper energy window", "what the "
            "file says", unit="keV", above=0, sizes=(3,), needs=(_SCATTER,), label="Widths (keV)"),
    Setting("counts.scatter_fwhm", float, None, "FWHM of the Gaussian that smooths the estimate of scatter", "it is not "
            "smoothed", unit="pixels", above=0, needs=(_SCATTER,), label="Smoothing (pixels)"),
    Setting("counts.scatter_tails", bool, False, "Subtract the photopeak's tails, computed from the energy resolution, from "
            "the scatter windows", needs=(_SCATTER, "model.isotope", "model.energy_fwhm"), label="Peak's Tails"),
    Setting("model.kind", str, "transmission", "Model of the images", label="Model", option="--model", words={
        "transmission": ("Radiograph", "Line integrals of the volume"),
        "emission": ("SPECT Counts", "Expected counts of the photons that a volume of activity emits"),
        "spectral": ("X-ray Counts", "Photons from the tubes of an X-ray system, or the panels' signal, over all energies, "
                     "by kVp, mAs and filters"),
        "inverse-square": ("Inverse Square Sum", "Line integrals weighted with the sensitivity to a point source, as 1/h^2: "
                           "no counts, for comparison"),
    }),
    Setting("model.time", float, 1.0, f"Acquisition time{_OF_MODULES}", unit="s", above=0, needs=(_COUNTS,
            "no frames.times"), label="Time (s)", of_modules=True),
    Setting("model.start", float, 0.0, f"Start of the acquisition after the reference time of the activity{_OF_MODULES}",
            unit="s", needs=(_COUNTS, "no frames.starts"), label="Start (s)", option="--start-time", of_modules=True),
    Setting("model.photons", float, None, "X-ray photons per pixel: a radiograph of attenuation coefficients then holds "
            "the transmitted photons", "line integrals", above=0, slider=1e6, needs=("model.kind=transmission",),
            unset="None"),
    Setting("model.isotope", str, None, "Isotope, whose photons are counted and whose activity decays during the "
            "acquisition", "one photon per decay, and a constant activity", words=_ISOTOPES, needs=(_COUNTS,), unset="None"),
    Setting("model.window", float, None, "Energy window of the counted photons, from and to", "10 % around the "
            "isotope's strongest line; of X rays, all", unit="keV", least=0, slider=1000, sizes=(2,), needs=(_PHOTONS,
            f"model.isotope or {_XRAYS}", "no model.panel=energy"), label="Window (keV)"),
    Setting("model.panel", str, "counting", "Signal of the X-ray panels", words={
        "counting": ("Counts Photons", "Number of photons in an energy window"),
        "energy": ("Integrates Energy", "Absorbed energy, keV"),
    }, needs=(_XRAYS,)),
    Setting("model.sensor", str, None, "Material of the panel that stops the X rays", "all are stopped",
            words=word_labels(("CdTe", "CZT", "silicon", "CsI")), needs=(_XRAYS,), unset="None"),
    Setting("model.sensor_thickness", float, 2.0, "Thickness of the panel's sensor", unit="mm", above=0, slider=5,
            needs=(_XRAYS, "model.sensor"), label="Sensor (mm)"),
    Setting("model.sensor_fwhm", float, 0.0, "FWHM of a panel's energy resolution", unit="keV", least=0, slider=20,
            needs=(_XRAYS, "no model.panel=energy"), label="FWHM (keV)"),
    Setting("model.materials", str, "water-bone", "Materials of the volume for X rays", words={
        "water-bone": ("Water and Bone", "By CT number: water up to 0, then a growing share of bone"),
        **word_labels(("water", "bone", "PMMA", "iodine", "aluminum", "copper"), "At the density that follows from mu"),
    }, needs=(_XRAYS,)),
    Setting("model.energy_fwhm", float, None, "FWHM of the detector's energy resolution at the window's line, as a share of "
            "its energy: a part of each line is counted, also of lines outside the window", "all photons within the window",
            above=0, most=0.99, slider=0.3, needs=(_COUNTS, "model.isotope"), label="Energy FWHM"),
    Setting("model.lines", str, "together", "Treatment of several lines of the isotope", label="Lines", words={
        "together": ("Together", "As photons of one kind, with effective coefficients"),
        "apart": ("Apart", "Each with its own attenuation, penetration and absorption: takes their number times as long"),
    }, needs=(_COUNTS, "model.isotope")),
    Setting("model.hole", str, "auto", "Model of the hole: the whole hole (auto; depth, never by rays), rays through "
            "points of it (rays), or its centre alone (point)", label="Hole", option="--hole", words={
        "auto": ("Automatic", "The depth-dependent pinhole response; rays where it is not available"),
        "depth": ("Depth-Dependent Response", "The depth-dependent pinhole response: the whole hole's blur, without rays"),
        "rays": ("Rays", "The blur of rays through points of the hole"),
        "point": ("Point", "An ideal pinhole: rays through the centre of the hole, no blur"),
    }, needs=(_COUNTS,)),
    Setting("model.aperture_points", int, None, "Points of the hole that rays pass; 1: its centre, no blur, 7 and more: the "
            "blur of a hole of this size", "as many as the hole's tolerance needs", least=1, slider=64,
            needs=(_COUNTS, "model.hole=rays", "no model.aperture_tolerance"), label="Hole Points"),
    Setting("model.aperture_tolerance", float, None, "In place of a number of points, as many as bring a voxel's image "
            "this close to that of the whole hole", "0.1, where rays are used", above=0, slider=1,
            needs=(_COUNTS, "model.hole=rays"), label="Hole Tolerance"),
    Setting("model.aperture_mu", float, None, "Material of the aperture's edge, or its attenuation coefficient at the "
            "photons' energy", "nothing penetrates it", unit="1/mm", words=word_labels(APERTURES, _BY_NAME), above=0,
            slider=10, needs=(_COUNTS,), label="Aperture", unset="None"),
    Setting("model.opening_angle_degrees", float, 90.0, "Full angle of the knife edge's cone", unit="degrees", above=0,
            most=179.9, needs=(_COUNTS, "model.aperture_mu or model.within_cone")),
    Setting("model.edge", str, "paix", "Model of the penetration of the aperture's edge", label="Knife Edge", words={
        "paix": ("Effective Diameter", "As if the hole were wider (Paix 1967)"),
        "path": ("Path Length", "Each ray by its path length in the edge"),
    }, needs=(_COUNTS, "model.aperture_mu")),
    Setting("model.plate_thickness", float, None, "Thickness of the aperture's plate, in whose middle the edge is",
            "infinite", unit="mm", above=0, slider=20, needs=(_COUNTS, "model.edge=path"), label="Plate (mm)"),
    Setting("model.wall_thickness", float, None, "Thickness of the collimators' walls, of the aperture's material: photons "
            "that pass them, or a neighbour's hole and walls, are counted", "nothing passes them", unit="mm", above=0,
            slider=20, needs=(_COUNTS, "model.aperture_mu"), label="Walls (mm)", unset="Opaque"),
    Setting("model.crystal_mu", float, None, "Material of the crystal that stops the photons, or its attenuation "
            "coefficient at their energy", "all photons are counted", unit="1/mm", words=word_labels(CRYSTALS, _BY_NAME),
            above=0, slider=5, needs=(_COUNTS,), label="Crystal", unset="None"),
    Setting("model.depth_layers", int, 1, "Depths in the crystal at which photons are recorded (parallax); 1: where they "
            "enter; without rays, more mean all depths", least=1, slider=8, needs=(_COUNTS, "model.crystal_mu")),
    Setting("model.intrinsic_fwhm", float, 0.0, "Full width at half maximum of the detector's own blur, on crystal or panel",
            unit="mm", least=0, slider=10, needs=(_PHOTONS,), label="Blur (mm)"),
    Setting("model.within_cone", bool, False, "Nothing passes steeper than the knife edge's cone", needs=(_COUNTS,),
            label="Knife-Edge Cone"),
    Setting("model.within_walls", bool, False, "The collimator's walls stop photons that would miss the crystal's front",
            needs=(_COUNTS,), label="Collimator Walls"),
    Setting("model.within_crystal", bool, False, "Pixels beyond the crystal's side detect nothing", needs=(_COUNTS,),
            label="Crystal's Side"),
    Setting("model.background", float, 0.0, "Expected counts of each pixel in the whole acquisition that do not come from "
            "the volume: scatter and dark counts", least=0, slider=100, needs=(_PHOTONS,), option="--background-counts"),
    Setting("model.efficiency", float, 1.0, f"Factor of the counts of the volume{_OF_MODULES}, or a file with an image for "
            "each module, as counts flood writes it; 0: dead", least=0, slider=2, needs=(_COUNTS,), of_modules=True,
            endings=(".npy", ".npz", ".h5", ".hdf5")),
    Setting("model.dead_time", float, 0.0, "Time for which a module is busy after a photon", unit="µs", least=0, slider=20,
            needs=(_COUNTS,), label="Dead Time (µs)"),
    Setting("model.dead_time_kind", str, "non-paralysable", "Effect of photons on a module that is busy", words={
        "non-paralysable": ("Non-Paralysable", "No effect: m = n / (1 + n dead time)"),
        "paralysable": ("Paralysable", "A new dead time begins: m = n exp(-n dead time)"),
    }, needs=(_COUNTS, "model.dead_time")),
    Setting("model.pixel_points", int, None, "Points of each pixel's area, for each point of the hole; auto: as many as "
            "the tolerance asks for, which takes longer for small voxels", "auto for counts, 1, its centre, for "
            "radiographs", words={"auto": ("Automatic", "")}, least=1, slider=100, needs=(_RAYS,)),
    Setting("model.tolerance", float, 0.02, "Largest error of a single voxel's total in any module, as a share of it",
            above=0, slider=1, needs=(_RAYS,)),
    Setting("scatter.model", str, "none", "Photons that the body scatters before a hole sees them", label="Scatter", words={
        "none": ("None", "They are left out"),
        "body": ("In the Body", "Simulated in the attenuation by Monte Carlo; takes an isotope and an energy resolution"),
    }, needs=(_COUNTS, _MADE), option="--scatter"),
    Setting("scatter.precision", float, 0.005, "Standard deviation of each module's total of scattered photons, as a share "
            "of it; half of it takes four times as long", above=0, most=0.5, slider=0.05,
            needs=(_COUNTS, "scatter.model=body"), option="--scatter-precision", label="Precision"),
    Setting("scatter.seed", int, 0, "Seed of the simulation of scatter; of several states or frames SEED, SEED + 1 …",
            least=0, most=2**31 - 1, needs=(_COUNTS, "scatter.model=body"), option="--scatter-seed", label="Scatter Seed"),
    Setting("detector.plane", str, "virtual", "Plane of the images", label="Detector", option="--detector", words={
        "virtual": ("Virtual", "Plane in front of the pinhole: upright, as the module's camera sees it"),
        "real": ("Real", "Front face of the crystal behind the pinhole: point-inverted"),
    }),
    Setting("detector.columns", int, 256, "Pixel columns of each image", least=1, most=1 << 20, label="Pixels X",
            option="--image-columns"),
    Setting("detector.rows", int, 256, "Pixel rows of each image", least=1, most=1 << 20, label="Pixels Y"),
    Setting("detector.magnification", float, 10.0, "Distance of the virtual detector from the pinhole, in units of the "
            "collimator's length l; no magnification l / b of the image on the crystal", above=0, slider=20,
            label="Distance (× l)"),
    Setting("detector.pitch", float, None, "Pixel size", "the image covers the crystal's whole side", unit="mm", above=0,
            slider=10, label="Pixel Size (mm)"),
    Setting("frames.times", float, None, "Durations of a scan's frames, or of a heart's gates: a run of each, as OUTPUT-1, "
            "OUTPUT-2 …, of the volume, or of each its state", "there is one frame", unit="s", above=0, sizes=(),
            needs=(_COUNTS, _MADE), option="--frame-times", label="Frame Times (s)"),
    Setting("frames.starts", float, None, "Starts of the frames after the reference time of the activity; gates all start "
            "with the scan", "each starts as the previous one ends", unit="s", sizes=(), needs=("frames.times",),
            option="--frame-starts", label="Frame Starts (s)"),
    Setting("frames.bins", float, None, "Energy bins of X rays, from, to, from, to …: a run of each, as OUTPUT-1, "
            "OUTPUT-2 …", "one, the window", unit="keV", least=0, sizes=(), option="--bins",
            needs=(_XRAYS, "no model.panel=energy", "no model.window", "no volume.states")),
    Setting("noise.seed", int, None, "Draw counts with this seed; of several states or frames with SEED, SEED + 1 …",
            "their expected means", least=0, most=2**64 - 1,
            needs=(f"model.photons or {_PHOTONS}", "no model.panel=energy", _MADE), option="--noise"),
    *choice_setting("noise.model", NOISE_MODELS, "How counts vary around their means", option="--noise-model",
                    needs=("noise.seed",)),
    Setting("reconstruction.method", str, "osem", "Reconstruction method", endings=METHOD_FILES,
            words={name: (method.label, method.text) for name, method in METHODS.items()}),
    *(_ARGUMENTS.pop(name) for name in ("iterations", "subsets")),
    Setting("reconstruction.voxels", int, None, "Voxels along x y z, or one number for all",
            "voxels are of half the smallest rod, or of half the resolution, if 64 to 128 of them cover the ROI; but not "
            "finer than half a pixel at the isocentre",
            least=1, sizes=(1, 3)),
    Setting("reconstruction.spacing", float, None, "Voxel size, one or three", "the voxels cover the ROI", unit="mm",
            above=0, slider=10, sizes=(1, 3), label="Voxel Size (mm)"),
    Setting("reconstruction.center", float, (0.0, 0.0, 0.0), "Centre of the volume, x y z", unit="mm", sizes=(3,)),
    Setting("reconstruction.allow", str, None, "Conditions that may differ from those of a network's training",
            words=word_labels(("scanner", "grid", "physics")), sizes=(), needs=("reconstruction.method=FILE.pt",)),
    Setting("reconstruction.hole", str, "auto", "Model of the hole's blur: auto is by depth, if the run's "
            "model allows it and no points are given", label="Hole's Blur", needs=(_METHOD_OF_COUNTS,), words={
        "auto": ("Automatic", "By depth, if the run's model allows it and no points are given; else by rays"),
        "depth": ("By Depth", "The whole hole, depth by depth: sharpest"),
        "rays": ("Rays", "Rays through some points of the hole: fast"),
    }),
    Setting("reconstruction.aperture_points", int, None, "Points of the hole that rays pass; 1: no recovery of its blur",
            "7 for rays, or those of the run if it was made with fewer", least=1, slider=64, label="Hole Points",
            needs=(_METHOD_OF_COUNTS, "no reconstruction.hole=depth"), option="--aperture-points"),
    Setting("reconstruction.pixel_points", int, 1, "Points of each pixel's area, for each point of the hole", least=1,
            slider=16, needs=(_METHOD_OF_COUNTS, "no reconstruction.hole=depth")),
    Setting("reconstruction.ignore_attenuation", bool, False, "Model no attenuation",
            needs=(_METHOD_OF_COUNTS,)),
    Setting("reconstruction.ignore_blur", bool, False, "Model no blur of the detector: no recovery of it",
            needs=(_METHOD_OF_COUNTS,), label="Ignore Detector Blur"),
    Setting("reconstruction.ignore_beam_hardening", bool, False, "Take the logarithms of polychromatic X rays without a "
            "correction for water", needs=(f"no {_METHOD_OF_COUNTS}",)),
    *_ARGUMENTS.values(),
    Setting("reconstruction.stop_change", float, None, "End when an iteration changes the objective by less than this share "
            "of it, such as 1e-5", "all iterations are done", above=0, slider=0.01),
    Setting("reconstruction.stop_noise", float, None, "End when the standard deviation in the region is this share of its "
            "mean", above=0, slider=1, needs=("reconstruction.stop_region",)),
    Setting("reconstruction.stop_region", float, None, "Ball of uniform activity in which noise is measured: x y z radius",
            unit="mm", sizes=(4,), needs=("reconstruction.stop_noise",)),
    Setting("reconstruction.stop_seconds", float, None, "End after this time", unit="s", above=0, slider=3600),
    Setting("compute.backend", str, "auto", "Backend that computes the line integrals", aliases=OLD_NAMES, words={
        "auto": ("Automatic", "The fastest that works here"), **{b.name: (b.label, b.text) for b in BACKENDS.values()},
    }),
    Setting("compute.threads", int, None, "Processor threads", "all", least=1, slider=64,
            needs=tuple(f"no compute.backend={b.name}" for b in BACKENDS.values() if b.own_threads)),
)  # fmt: skip

_TABLE_NEEDS = {"phantom": _PHANTOM, "counts": ("counts.files",)}
"""Conditions of `Setting.needs` of all settings of a table, except those that a condition names."""


def _with_table_needs(row: Setting) -> Setting:
    """Return a setting with the conditions of its table added to its own."""
    needs = _TABLE_NEEDS.get(row.key.partition(".")[0], ())
    return row if row.key in needs else dataclasses.replace(row, needs=(*needs, *row.needs))


SETTINGS: Mapping[str, Setting] = MappingProxyType({row.key: _with_table_needs(row) for row in _DECLARED})
"""Settings by their keys, table by table; `settings_with` adds the settings of a kind of phantom."""


def phantom_settings(name: str, row: type[Setting] = UncheckedSetting, **details: Any) -> Iterator[Setting]:
    """Yield the settings of the kind of phantom of that name, one for each field of its class, as rows of class `row`.

    There are none for an unknown name. `details` are further attributes of all rows.
    """
    for kind in KINDS:
        fields = {field.name: field for field in dataclasses.fields(kind.phantom)} if kind.name == name else {}
        for key, field in setting_names(kind.phantom).items() if fields else ():
            default, text = kind.usual.get(field, fields[field].default), fields[field].metadata.get("text", "")
            yield default_setting(key, default, text, row, **details)


@functools.cache
def settings_with(kind: str) -> Mapping[str, Setting]:
    """Return every setting by its key, with those of a kind of phantom."""
    rows = phantom_settings(kind, needs=_PHANTOM_NUMBER)
    return MappingProxyType({**SETTINGS, **{f"phantom.{row.key}": row for row in rows}})


TABLES = table_names(SETTINGS)
"""Names of the tables of a recipe."""

HOW_TABLES = ("reconstruction", "model", "attenuation", "compute")
"""Tables of the settings of a run's reconstruction; the other tables have the settings of its images."""

SAMPLING = tuple(f"model.{name}" for name in ("aperture_points", "aperture_tolerance", "pixel_points", "tolerance"))
"""Keys of the numbers of rays and of their tolerances; counts have them only if the hole is modelled by rays."""
