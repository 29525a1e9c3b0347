"""Command ``mphdrr xray ACTION``: motion since a reference, kerma of an X-ray scan, absorbed dose of an activity."""

import argparse

import numpy as np

from ... import core as mph
from ..errors import warn
from ..volumes.resampling import outside_warnings
from ..volumes.volume_files import VOLUME_FORMATS
from .options import add_actions, add_run, describe_volume, output_path, print_answer
from .scanners import add_workbook

_LEAST_DENSITY = 0.05
"""Smallest density, g/cm^3, between air and lung; the dose in a thinner medium would only be noise."""


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command ``mphdrr xray`` with its actions."""
    actions = add_actions(subparsers, "xray", "mphdrr xray kerma both.xlsx")

    add = add_run(actions, "motion", _motion).add_argument
    add("radiographs", metavar="RUN", help="radiographs of the body now")
    add("reference", metavar="VOLUME", help="attenuation of the body before, such as a reconstruction")
    add("--change", metavar="FILE", help=f"also write the change beside the motion: {', '.join(VOLUME_FORMATS)}")
    add("--json", action="store_true", help="print JSON")

    kerma = add_run(actions, "kerma", _kerma)
    add_workbook(kerma)
    kerma.add_argument("--json", action="store_true", help="print JSON")

    add = add_run(actions, "dose", _dose).add_argument
    add("activity", metavar="VOLUME", help="activity, kBq/mL")
    add("--isotope", required=True, choices=tuple(mph.ISOTOPES), help="isotope of the activity")
    add("--ct", metavar="VOLUME", help="CT numbers, for the density 1 + HU / 1000 g/cm^3; default: water everywhere")
    add("--biological-half-life", type=float, metavar="H", help="hours; default: no biological elimination")
    add("--rate", action="store_true", help="write the initial dose rate, mGy/h, instead of the dose, mGy")
    add("-o", "--output", required=True, metavar="FILE", help=", ".join(VOLUME_FORMATS))


def _motion(arguments: argparse.Namespace) -> None:
    """Find the motion of a body since a reference volume.

    mphdrr xray motion radiographs.h5 mu70.nii.gz --change change.nii.gz
    """
    from ..runs.reconstructing import line_integrals

    path = output_path(arguments.change, VOLUME_FORMATS) if arguments.change else None
    run, reference = mph.read_run(arguments.radiographs), mph.read_volume(arguments.reference, "mu")
    images = line_integrals(run, run.recipe)
    motion = mph.find_motion(reference, images, run.views, run.recipe["model.photons"])
    deviations = np.sqrt(np.diag(motion.covariance)) * np.array([1.0] * 3 + [np.degrees(1)] * 3)
    degrees = np.degrees(motion.rotation)
    record = {
        "shift_mm": motion.shift.tolist(), "rotation_degrees": degrees.tolist(), "center_mm": motion.center.tolist(),
        "deviations": deviations.tolist(), "pose": motion.pose.tolist(), "settled": motion.settled,
    }  # fmt: skip
    numbers = zip((*motion.shift, *degrees), deviations, ("mm",) * 3 + ("degrees",) * 3, "xyzxyz", strict=True)
    print_answer(arguments, record, [f"{axis} {x:+9.3f} ± {s:.2g} {unit}" for x, s, unit, axis in numbers])
    if path is not None:
        mph.write_volume(mph.find_change(reference, images, run.views, motion), path)


def _kerma(arguments: argparse.Namespace) -> None:
    """Compute the air kerma of a scan with the X-ray sources at the isocentre, without a body.

    mphdrr xray kerma both.xlsx
    """
    system = mph.read_scanner(arguments.workbook, arguments.scanner_kind or "x-ray", arguments.columns)
    kerma = mph.isocentre_kerma(system)  # type: ignore[arg-type]
    record = {"micrograys": kerma.tolist(), "scan_micrograys": float(kerma.sum())}
    print_answer(arguments, record, [f"{kerma.sum():.4g} µGy of air kerma at the isocentre, by {len(kerma)} sources"])


def _dose(arguments: argparse.Namespace) -> None:
    """Compute the absorbed dose of an activity.

    mphdrr xray dose spect.nii.gz --isotope Lu-177 -o dose.nii.gz
    mphdrr xray dose spect.nii.gz --isotope Tc-99m --ct ct.nii.gz --rate -o rate.nii.gz
    """
    path = output_path(arguments.output, VOLUME_FORMATS)
    activity, density = mph.read_volume(arguments.activity, "activity"), None
    if arguments.ct:
        ct = mph.read_volume(arguments.ct, "hu")
        for text in outside_warnings(activity, ct.grid, "the CT", "where its density is taken as air's"):
            warn(text)
        hu = mph.resample(ct, activity.grid)
        density = np.maximum(1 + hu.array / 1000, _LEAST_DENSITY)
    dose = mph.absorbed_dose_rate(activity, arguments.isotope, density)
    if not arguments.rate:
        dose = mph.absorbed_dose(dose, arguments.isotope, arguments.biological_half_life)
    mph.write_volume(dose, path)
    print(f"{path}: {describe_volume(dose)} {dose.unit}")
