"""Every warning of a run is also one of the event with the same settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.events import EventMaker, EventRecipe
from mphdrr.core.recipes.toml import toml_value
from mphdrr.core.recording import recorded_warnings

from .small_events import WORKBOOK

VOXELS, SPACING = 16, 10.0
GRID = mph.Grid.centered(VOXELS, SPACING)
BASE: dict[str, Any] = {
    "system.file": str(WORKBOOK), "system.modules": "1-2", "detector.rows": 6, "detector.columns": 6,
    "phantom.voxels": (VOXELS,), "phantom.spacing": (SPACING,),
}  # fmt: skip
COUNTS = {"model.kind": "emission", "model.hole": "point", "model.pixel_points": 1, "model.tolerance": 1e6}
TC = {**COUNTS, "model.isotope": "Tc-99m"}

CASES = {
    "no warning": (COUNTS, None),
    "activity below 0": (COUNTS | {"volume.file": "below.npz", "volume.quantity": "activity"}, "activity is -1 to 2"),
    "pixels beside the crystal": (COUNTS | {"detector.pitch": 88.0}, "wider than the crystal"),
    "pixels that cover too much": (COUNTS | {"detector.pitch": 100.0}, "but the virtual detector's side is"),
    "isocentre outside": (COUNTS | {"phantom.position": (200.0, 0.0, 0.0)}, "isocentre, at which the modules aim"),
    "detector within the volume": ({"detector.magnification": 1.0}, "virtual detectors stand in front"),
    "few points of a pixel": (COUNTS | {"model.tolerance": 1e-3}, "with 1 point of each pixel the total counts"),
    "metres": ({"phantom.spacing": (0.01,)}, "lengths are in mm; is it in metres"),
    "aperture in 1/cm": (COUNTS | {"model.aperture_mu": 40.0}, "aperture_mu is 40 1/mm"),
    "crystal in 1/cm": (COUNTS | {"model.crystal_mu": 40.0}, "crystal_mu is 40 1/mm"),
    "mu in 1/cm": (COUNTS | {"attenuation.file": "mu_cm.npz"}, "mu is 0.15 1/mm where most photons are lost"),
    "the phantom's mu in 1/cm": (
        COUNTS | {"phantom.kind": "derenzo", "phantom.mu": 0.9, "attenuation.of_phantom": True},
        "1/mm where most photons are lost",
    ),
    "mu at another energy": (
        TC | {"attenuation.file": "ct.npz", "attenuation.energy": 80.0}, "the mu of ct.npz holds at 80 keV",
    ),
    "mu at another isotope's": (
        TC | {"attenuation.file": "ct.npz", "attenuation.energy": "Tl-201"}, "the mu of ct.npz holds at 71.07 keV",
    ),
    "the phantom's mu at another energy": (
        TC | {"model.isotope": "Tl-201", "phantom.kind": "derenzo", "attenuation.of_phantom": True}, "of the Derenzo",
    ),
    "CT numbers of padding": (TC | {"attenuation.file": "padded.npz", "attenuation.energy": 140.5}, "below -1024 HU"),
    "CT numbers of metal": (TC | {"attenuation.file": "metal.npz", "attenuation.energy": 140.5}, "above 3071 HU"),
    "CT numbers of water": (TC | {"attenuation.file": "water.npz", "attenuation.energy": 140.5}, "of water alone"),
    "photons through CT": ({"volume.file": "metal.npz", "volume.energy": 60.0, "model.photons": 1e3}, "above 3071 HU"),
    "no place in a file": (COUNTS | {"volume.file": "nowhere.nii"}, "does not say where the patient lies"),
    "phantom cut off": (COUNTS | {"phantom.kind": "shepp-logan", "phantom.spacing": (8.0,)}, "lies outside"),
    "rods that do not fit": (
        COUNTS | {"phantom.kind": "derenzo", "phantom.rod_diameters": (60.0, 8, 6, 5, 4, 3)}, "no rod of 60 mm fits",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Write the volumes that the settings name."""
    folder = tmp_path_factory.mktemp("volumes")
    shape = GRID.shape
    for name, quantity, low, high in (
        ("below", "activity", -1, 2), ("mu_cm", "mu", 0, 0.15), ("ct", "hu", -1000, 50), ("padded", "hu", -2000, 50),
        ("metal", "hu", -1000, 9000), ("water", "hu", 0, 2),
    ):  # fmt: skip
        values = np.full(shape, low, np.float32)
        values[4:12, 4:12, 4:12] = high
        mph.write_volume(mph.Volume(values, GRID, quantity), folder / f"{name}.npz")
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(np.ones(shape, np.float32), None)
    image.header.set_zooms((SPACING,) * 3)
    nibabel.save(image, folder / "nowhere.nii")
    return folder


def event_text(given: dict[str, Any]) -> str:
    """Return the recipe of events with the settings of a run: its first phantom is the run's."""
    names = ("system", "detector", "truth", "phantoms", "pose", "model")
    tables: dict[str, dict[str, Any]] = {name: {} for name in names}
    is_mu = "model.photons" in given
    tables["truth"] = {"voxels": VOXELS, "spacing": given["phantom.spacing"][0]}
    tables["truth"]["quantity"] = "mu" if is_mu else "activity"
    places = {
        "volume.file": "phantoms.file", "volume.energy": "phantoms.energy", "phantom.position": "pose.position",
        "attenuation.file": "model.attenuation", "attenuation.energy": "model.attenuation_energy",
    }  # fmt: skip
    for key, value in given.items():
        if key == "attenuation.of_phantom":
            key, value = "model.attenuation", "phantom"
        table, _, name = places.get(key, key).partition(".")
        if key not in ("phantom.voxels", "phantom.spacing", "volume.quantity"):
            tables["phantoms" if table == "phantom" else table][name] = value
    if "file" not in tables["phantoms"]:
        tables["phantoms"] = {"kind": "derenzo", **tables["phantoms"]}
    if "position" in tables["pose"]:
        tables["truth"]["center"] = tables["pose"]["position"]
    headings = {"phantoms": "[[phantoms]]", "pose": "[phantoms.pose]", "model": "[models.images]"}
    lines = ["version = 1"]
    for table, entries in tables.items():
        lines.append(headings.get(table, f"[{table}]"))
        lines += [f"{key} = {toml_value(value)}" for key, value in entries.items()]
    return "\n".join([*lines, 'kind = "transmission"'] if "kind" not in tables["model"] else lines)


@pytest.mark.parametrize("case", CASES)
def test_an_event_gives_the_warnings_of_a_run_of_the_same_settings(folder, scanner, case):
    changes, expected = CASES[case]
    given = BASE | {key: str(folder / value) if key.endswith(".file") else value for key, value in changes.items()}
    is_phantom = "volume.file" not in given
    recipe = {key: value for key, value in given.items() if is_phantom or not key.startswith("phantom.")}
    with recorded_warnings() as of_run:
        (run,) = mph.run_recipe(mph.Recipe(recipe), scanner)
    with recorded_warnings() as of_set:
        maker = EventMaker(EventRecipe(event_text(given), folder=folder))
        vars(maker)["system"] = scanner[:2]  # the same, read once
        first = maker.make(0)
        again = maker.make(1)
    assert any(expected in text for text in of_run) if expected else not of_run, of_run
    assert {*of_set, *first.warnings} == set(of_run)
    assert again.warnings == first.warnings  # each event says all of its own
    np.testing.assert_allclose(first.images["images"], run.projections, rtol=1e-6, atol=1e-6)


def test_events_of_one_maker_have_the_same_warnings_whichever_is_first(folder):
    text = event_text(BASE | {"phantom.spacing": (0.01,)}) + "\n[radon]\nangles = 2\n"
    recipe = EventRecipe(text, folder=folder)
    one, other = EventMaker(recipe), EventMaker(recipe)
    assert [one.make(number).warnings for number in (0, 1)] == [other.make(number).warnings for number in (1, 0)]


def test_the_mu_of_an_events_volume_is_compared_with_the_model(folder):
    text = event_text(BASE | TC | {"volume.file": str(folder / "below.npz")})
    text = text.replace("[[phantoms]]", f"[[phantoms]]\nmu_file = {toml_value(str(folder / 'ct.npz'))}\nenergy = 80")
    text = text.replace("[models.images]", '[models.images]\nattenuation = "phantom"')
    event = EventMaker(EventRecipe(text, folder=folder)).make(0)
    assert "the mu of ct.npz holds at 80 keV, photons of 126.45 to 154.55 keV are counted" in event.warnings
