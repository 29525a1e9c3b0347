"""``mphdrr xray ACTION``: motion since a reference, kerma of a CT scan, absorbed dose of an activity."""

import argparse

import numpy as np

from ... import core as mph
from ..volumes.volume_files import VOLUME_FORMATS
from ..xray.dose import decays
from .options import add_actions, add_run, described, output_path, print_answer
from .scanners import add_workbook

_LEAST_DENSITY = 0.05
"""g/cm^3, of air and thin lung: the dose of electrons in less would be that of noise."""


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    actions = add_actions(subparsers, "xray", "mphdrr xray kerma both.xlsx")

    motion = add_run(actions, "motion", _motion)
    add = motion.add_argument
    add("radiographs", metavar="RUN", help="of the body now")
    add("reference", metavar="VOLUME", help="the body before: its attenuation, such as a reconstruction")
    add("--change", metavar="FILE", help=f"also write what else has changed: {', '.join(VOLUME_FORMATS)}")
    add("--json", action="store_true", help="print JSON")

    kerma = add_run(actions, "kerma", _kerma)
    add_workbook(kerma)
    kerma.add_argument("--json", action="store_true", help="print JSON")

    dose = add_run(actions, "dose", _dose)
    add = dose.add_argument
    add("activity", metavar="VOLUME", help="activity, kBq/mL")
    add("--isotope", required=True, choices=tuple(decays()), help="of the activity")
    text = "CT numbers, of which the density is made, 1 + HU / 1000; default: water everywhere"
    add("--ct", metavar="VOLUME", help=text)
    add("--biological-half-life", type=float, metavar="H", help="hours; default: nothing is washed out")
    add("--rate", action="store_true", help="the dose rate at the beginning, mGy/h, instead of the dose, mGy")
    add("-o", "--output", required=True, metavar="FILE", help=", ".join(VOLUME_FORMATS))


def _motion(arguments: argparse.Namespace) -> None:
    """Find how a body has moved since a reference volume.

    mphdrr xray motion radiographs.h5 mu70.nii.gz --change change.nii.gz
    """
    from ..runs.reconstructing import line_integrals

    path = output_path(arguments.change, VOLUME_FORMATS) if arguments.change else None
    run, reference = mph.read_run(arguments.radiographs), mph.read_volume(arguments.reference, "mu")
    images = line_integrals(run, run.recipe)
    found = mph.find_motion(reference, images, run.views, run.recipe["model.photons"])
    deviations = np.sqrt(np.diag(found.covariance)) * np.array([1.0] * 3 + [np.degrees(1)] * 3)
    degrees = np.degrees(found.rotation)
    record = {
        "shift_mm": found.shift.tolist(), "rotation_degrees": degrees.tolist(), "center_mm": found.center.tolist(),
        "deviations": deviations.tolist(), "pose": found.pose.tolist(), "settled": found.settled,
    }  # fmt: skip
    numbers = zip((*found.shift, *degrees), deviations, ("mm",) * 3 + ("degrees",) * 3, "xyzxyz", strict=True)
    print_answer(arguments, record, [f"{axis} {x:+9.3f} ± {s:.2g} {unit}" for x, s, unit, axis in numbers])
    if path is not None:
        mph.write_volume(mph.find_change(reference, images, run.views, found), path)


def _kerma(arguments: argparse.Namespace) -> None:
    """Say how much air kerma a scan of the X-ray sources is at the isocentre, without a body.

    mphdrr xray kerma both.xlsx
    """
    system = mph.read_scanner(arguments.workbook, arguments.scanner_kind or "x-ray", arguments.columns)
    each = mph.isocentre_kerma(system)  # type: ignore[arg-type]
    record = {"micrograys": each.tolist(), "scan_micrograys": float(each.sum())}
    print_answer(arguments, record, [f"{each.sum():.4g} µGy of air kerma at the isocentre, by {len(each)} sources"])


def _dose(arguments: argparse.Namespace) -> None:
    """Calculate the absorbed dose of an activity.

    mphdrr xray dose spect.nii.gz --isotope Lu-177 -o dose.nii.gz
    mphdrr xray dose spect.nii.gz --isotope Tc-99m --ct ct.nii.gz --rate -o rate.nii.gz
    """
    path = output_path(arguments.output, VOLUME_FORMATS)
    activity, density = mph.read_volume(arguments.activity, "activity"), None
    if arguments.ct:
        hu = mph.resample(mph.read_volume(arguments.ct, "hu"), activity.grid)
        density = np.maximum(1 + hu.array / 1000, _LEAST_DENSITY)
    dose = mph.absorbed_dose_rate(activity, arguments.isotope, density)
    if not arguments.rate:
        dose = mph.absorbed_dose(dose, arguments.isotope, arguments.biological_half_life)
    mph.write_volume(dose, path)
    print(f"{path}: {described(dose)} {dose.unit}")
