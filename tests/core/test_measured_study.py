"""The measured study of docs/measured-studies.md: one recipe brings back what was scanned, and each correction matters."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import mphdrr.core as mph

pytest.importorskip("pydicom")


@pytest.fixture(scope="module")
def example() -> ModuleType:
    path = Path(__file__).parents[2] / "examples" / "measured_study.py"
    spec = importlib.util.spec_from_file_location("measured_study", path)
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


def test_one_recipe_imports_dicom_and_interfile(example, tmp_path):
    example.write_study(tmp_path, modules=8, pixels=16)
    truth, recipe = np.load(tmp_path / "truth.npz"), mph.read_recipe(tmp_path / "study.toml")
    example.find_efficiency(tmp_path, recipe)
    (dicom,) = example.runs_of(recipe)
    (interfile,) = example.runs_of(recipe.updated({"counts.files": [str(tmp_path / "scan.hdr")]}))
    for name in ("projections", "background", "efficiency"):
        np.testing.assert_array_equal(getattr(dicom, name), getattr(interfile, name))
    for run in (dicom, interfile):
        np.testing.assert_allclose(run.recipe["model.time"], truth["times"])
        np.testing.assert_allclose(run.recipe["model.start"], 10_800 + truth["starts"])
    np.testing.assert_array_equal(dicom.efficiency == 0, truth["dead"] | truth["hot"])
    lives = dicom.efficiency > 0
    off = (dicom.efficiency[lives] / truth["efficiency"][lives] - 1) * np.sqrt(
        example.FLOOD * truth["efficiency"][lives]
    )
    assert off.std() == pytest.approx(1, rel=0.1), (
        "but for the flood's noise, the efficiencies are those that there were"
    )


@pytest.mark.long
def test_all_corrections_are_right_and_each_is_needed(example, tmp_path):
    example.write_study(tmp_path, modules=20)
    found = example.numbers_of(example.reconstructed(tmp_path))
    _, off, deviation, _ = found[example.ALL]
    assert abs(off) < 0.02
    assert found["all, from Interfile"] == found[example.ALL]
    for name in (
        "starts",
        "decay before the scan",
        "efficiencies of the others",
        "dead time",
        "scatter",
        "attenuation",
    ):
        assert abs(found[name][1] - off) > 0.06, name
    for name in ("exposures", "dead module", "dead and hot pixels", "efficiencies of the others"):
        assert found[name][2] ** 2 - deviation**2 > 0.03**2, "variances of noise and of what is not corrected add up"
    assert all(changed > 0.05 for name, (*_, changed) in found.items() if not name.startswith(("all", "without")))
