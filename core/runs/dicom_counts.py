"""Counts of a run written as DICOM: a planar nuclear medicine image (part 3, C.8.4) with a detector for each module."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import InputError, naming
from ..files import AnyPath, replacing, require_ending
from ..physics.isotopes import isotope
from ..volumes.formats.dicom_writing import add_pixels, decimals, new_header, save_image, set_tags, to_16_bits
from .run import ProjectionRun


def write_counts(
    run: ProjectionRun, path: AnyPath, *, template: AnyPath | None = None, tags: Mapping[str, Any] | None = None
) -> None:
    """Write the counts of a run as DICOM (.dcm): a frame for each module, as it lies on the crystal (back-v).

    The file holds exposure, pixel size on the crystal and, if the run has one, energy window. `template` and `tags` are
    those of `write_volume`. `InputError` is raised for a run that is not of counts, and for modules with other exposures or
    pixels than the first.
    """
    require_ending(path, (".dcm",))
    with naming(path):
        if run.unit != "counts":
            raise InputError(f"expected a run of counts, got one in {run.unit}")
        times = np.unique(_stated(run, "time"))
        steps = np.linalg.norm([run.views.u_steps, run.views.v_steps], axis=2).T / run.settings["magnification"]
        milliseconds = round(1000 * float(times[0]))
        for item, is_one in (
            ("exposure in whole milliseconds", len(times) == 1 and math.isclose(milliseconds, 1000 * times[0])),
            ("pixel size", np.allclose(steps, steps[0], rtol=1e-6)),
        ):
            if not is_one:
                raise InputError(f"expected one {item} for all modules: DICOM has one for all detectors")
        images = run.projections[:, ::-1, ::-1] if run.settings["detector"] == "virtual" else run.projections
        stored, slope = to_16_bits(images.T, 1.0)
        data = new_header("NM", template, tags or {})
        add_pixels(data, stored, slope, steps[0], "{counts}", "counts")
        nuclide, window, energies = _stated(run, "isotope"), _stated(run, "window"), []
        if nuclide or window:
            low, high = decimals(window or isotope(nuclide).window)
            limits = set_tags(None, EnergyWindowLowerLimit=low, EnergyWindowUpperLimit=high)
            energies = [set_tags(None, EnergyWindowRangeSequence=[limits])]
        place = {"ImagePositionPatient": None, "ImageOrientationPatient": None}
        detectors = [set_tags(None, CollimatorType="PINH", FocalDistance=None, **place) for _ in stored]
        set_tags(
            data, ImageType=["DERIVED", "PRIMARY", "STATIC", "EMISSION"], NumberOfFrames=len(stored),
            FrameIncrementPointer=[0x00540010, 0x00540020], EnergyWindowVector=[1] * len(stored), NumberOfEnergyWindows=1,
            DetectorVector=list(range(1, len(stored) + 1)), NumberOfDetectors=len(stored), ActualFrameDuration=milliseconds,
            EnergyWindowInformationSequence=energies, DetectorInformationSequence=detectors,
            ImageComments="orientation back-v: columns along the module's +u, rows along +v",
        )  # fmt: skip
        del data.RotationInformationSequence
        with replacing(path) as temporary:
            save_image(data, 1, stored, temporary)


def _stated(run: ProjectionRun, name: str) -> Any:
    """Return a value of the model that a run records, in its settings or its recipe, or None."""
    return run.settings.get(name) or (run.recipe[f"model.{name}"] if "recipe" in run.settings else None)
