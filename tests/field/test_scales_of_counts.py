"""Factors and sizes that files of counts state are applied, or refused by name.

https://github.com/UCL/STIR/issues/1123 (real-world values of counts); Interfile 3.3 and the keys of STIR; DICOM PS3.3
C.7.6.16.2.11.
"""

from __future__ import annotations

import numpy as np
import pytest

import mphdrr.core as mph

from ..core.conftest import refused, warned
from .conftest import write_interfile

FACTORS = ("quantification units", "image scaling factor [1]", "rescale slope", "data rescale slope", "scale factor")


@pytest.mark.parametrize("key", FACTORS)
@pytest.mark.parametrize("factor", [0.5, 0.001, 2.0, 1 / 3000])
def test_a_factor_of_interfile_is_applied(frames, tmp_path, key, factor):
    path = write_interfile(tmp_path / "a.hdr", 6 * frames / factor, f"{key} := {factor!r}", kind="<u4")
    np.testing.assert_allclose(mph.read_counts(path), 6 * frames, rtol=1e-9)


@pytest.mark.parametrize("stored", [[0, 1, 2], [0, 3, 40], [0, 1, 100], [1, 50, 101]])
def test_expected_counts_in_fine_steps_are_not_rounded(frames, tmp_path, stored):
    numbers = np.resize(stored, frames.shape)
    path = write_interfile(tmp_path / "a.hdr", numbers, "image scaling factor [1] := 0.01")
    np.testing.assert_allclose(mph.read_counts(path), 0.01 * numbers)


def test_factors_that_differ_are_refused_and_words_are_none(frames, tmp_path):
    path = tmp_path / "a.hdr"
    both = "quantification units := 0.5", "image scaling factor [1] := 0.25"
    refused(
        lambda: mph.read_counts(write_interfile(path, frames, *both)), "quantification units = 0.5 and image scaling"
    )
    assert (mph.read_counts(write_interfile(path, frames, "quantification units := counts")) == frames).all()
    one_each = [f"image scaling factor [{k}] := {k}" for k in (1, 2)]
    counts = mph.read_counts(write_interfile(path, frames, *one_each))
    np.testing.assert_array_equal(counts, frames * np.repeat([1, 2], 12)[:, None, None])
    refused(lambda: mph.read_counts(write_interfile(path, frames, "scale factor := 0")), "multiplied by 0")
    refused(lambda: mph.read_counts(write_interfile(path, frames, "rescale slope := kBq")), "rescale slope = kBq")
    shifted = write_interfile(path, frames + 7, "rescale slope := 1", "rescale intercept := -7")
    np.testing.assert_array_equal(mph.read_counts(shifted), frames)


@pytest.mark.parametrize(
    "unit, size, mm", [("cm/pixel", 0.41, 4.1), ("mmpixel", 3.2, 3.2), ("mm/pixel", 5.5, 5.5), ("cm", 0.2, 2.0)]
)
def test_pixel_sizes_have_the_unit_that_they_say(frames, tmp_path, unit, size, mm):
    lines = [f"scaling factor ({unit}) [{axis}] := {size}" for axis in (1, 2)]
    about = mph.read_counts(write_interfile(tmp_path / "a.hdr", frames, *lines)).about
    np.testing.assert_allclose(about[0, 1:3], mm)
    wrong = write_interfile(tmp_path / "a.hdr", frames, "scaling factor (inch/pixel) [1] := 0.1")
    refused(lambda: mph.read_counts(wrong), "scaling factor (inch/pixel) [1] = 0.1: expected its unit")


@pytest.mark.parametrize(
    "line, words",
    [
        ("matrix size [1] := 6.5", "matrix size [1] = 6.5: expected a whole number"),
        ("number of energy windows := 1e9", "number of energy windows = 1e9: expected a whole number"),
        ("number of energy windows := -1", "number of energy windows = -1"),
        ("number of energy windows := 7", "expected one that divides the 24 images"),
        ("data offset in bytes := -8", "data offset in bytes = -8"),
        ("imagedata byte order := PDP", "expected LITTLEENDIAN or BIGENDIAN"),
    ],
)
def test_numbers_of_no_sense_are_refused_by_name(frames, tmp_path, line, words):
    refused(lambda: mph.read_counts(write_interfile(tmp_path / "a.hdr", frames, line)), words)


@pytest.mark.parametrize("ending", ["hdr", "h00", "h01", "hs", "txt"])
@pytest.mark.parametrize("begin", ["", "\ufeff", "  ", "\n\n"])
def test_headers_are_known_by_their_first_word(frames, tmp_path, ending, begin):
    path = write_interfile(tmp_path / f"a.{ending}", frames, "image duration (sec) := 5", kind=">u2")
    path.write_text(begin + path.read_text(encoding="utf-8"), encoding="utf-8")
    np.testing.assert_array_equal(mph.read_counts(path), frames)


@pytest.mark.parametrize("slope", [0.01, 0.25, 3.0])
def test_real_world_values_of_counts_are_applied(frames, tmp_path, slope):
    pytest.importorskip("pydicom")
    from ..core import dicom_files

    path, stored = tmp_path / "rw.dcm", np.rint(frames * 3 / slope)
    mapped = {"RealWorldValueMappingSequence": [dicom_files.real_world_values(slope, 0.0, "{counts}")]}
    dicom_files.write_frames(stored, path, 1000, **mapped)
    np.testing.assert_array_equal(mph.read_counts(path), 3 * frames)
    dicom_files.write_frames(stored, path, 1000, RescaleSlope=slope, RescaleIntercept=0, **mapped)
    np.testing.assert_array_equal(mph.read_counts(path), 3 * frames)
    dicom_files.write_frames(stored, path, 1000, RescaleSlope=7 * slope, RescaleIntercept=0, **mapped)
    refused(lambda: mph.read_counts(path), "its rescaling is", "RealWorldValueMapping")
    mapped["RealWorldValueMappingSequence"] = [dicom_files.real_world_values(slope, 0.0, "Bq/ml")]
    dicom_files.write_frames(stored, path, 1000, **mapped)
    refused(lambda: mph.read_counts(path), "values in Bq/ml; expected counts")


@pytest.mark.parametrize("size, digits", [(0.78125, 2), (1.1719, 2), (2.3976, 3), (4.7952, 2)])
def test_a_pixel_size_in_few_digits_is_no_contradiction(frames, tmp_path, size, digits):
    scanner = mph.PinholeSystem(np.array([[200.0, 0, 0]]), 2.0, 60.0, 6 * size, 9.0, 75.0)

    def warnings(stated: float) -> list[str]:
        lines = [f"scaling factor (mm/pixel) [{axis}] := {stated:.{digits}f}" for axis in (1, 2)]
        path = write_interfile(tmp_path / "p.hdr", frames[:1], "image duration (sec) := 60", *lines)
        return warned(lambda: mph.counts_run(mph.read_counts(path), scanner, "1", "back-v"))

    assert warnings(size) == []
    assert "the file says pixels of" in warnings(1.03 * size)[0]
