"""DICOM volumes: their units, their place, and which files belong to them.

https://github.com/MRtrix3/mrtrix3/issues/2977 and https://github.com/rordenlab/dcm2niix/issues/144 (private sequences),
https://github.com/rordenlab/dcm2niix/issues/253 (tilted gantry), https://github.com/moloney/dcmstack/issues/55 (uneven
slices), https://github.com/dgobbi/vtk-dicom/issues/26 (real-world values).
"""

from __future__ import annotations

import gzip
import shutil
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph

from ..core.conftest import refused, warned

pydicom = pytest.importorskip("pydicom")

from pydicom.dataset import Dataset  # noqa: E402
from pydicom.uid import EnhancedCTImageStorage  # noqa: E402

from ..core import dicom_files  # noqa: E402


@pytest.fixture
def ct(rng: np.random.Generator) -> mph.Volume:
    """Return a small CT of whole, even numbers, on an oblique grid."""
    affine = mph.euler_pose(0.2, -0.1, 0.3) @ np.diag([0.9, 1.5, 2.5, 1.0])
    affine[:3, 3] = [-20, 35.5, -60]
    return mph.Volume(2.0 * rng.integers(-500, 500, (6, 5, 7)), mph.Grid((6, 5, 7), affine), "hu")


def same(volume: mph.Volume, expected: mph.Volume, atol: float = 1e-4) -> None:
    """Check that volumes have the same voxels at the same places."""
    np.testing.assert_allclose(volume.array, expected.array, atol=1e-3)
    np.testing.assert_allclose(volume.grid.affine, expected.grid.affine, atol=atol)


UNITS = [
    ("kBq/ml", "activity", 1.0), ("MBq/mL", "activity", 1e3), ("Bq/cm3", "activity", 1e-3), ("BQML", "activity", 1e-3),
    ("/cm", "mu", 0.1), ("cm-1", "mu", 0.1), ("1/mm", "mu", 1.0), ("mm-1", "mu", 1.0), ("[hnsf'U]", "hu", 1.0),
]  # fmt: skip


@pytest.mark.parametrize("code, quantity, factor", UNITS)
def test_real_world_values_of_tomograms_have_their_unit(ct, tmp_path, code, quantity, factor):
    stored = ct.array + 1000
    path = tmp_path / "t.dcm"
    mapped = [dicom_files.real_world_values(0.25, 3.0, code)]
    volume = mph.Volume(2 * stored + 1, ct.grid)  # what `write_tomogram` stores
    dicom_files.write_tomogram(volume, path, RealWorldValueMappingSequence=mapped)
    for stated in (None, quantity):
        read = mph.read_volume(path, stated)
        assert read.quantity == quantity
        np.testing.assert_allclose(read.array, factor * (0.25 * stored + 3.0), rtol=1e-6)
    other = "mu" if quantity == "activity" else "activity"
    refused(lambda: mph.read_volume(path, other), f"it holds {quantity}, expected {other}")


def test_counts_and_unknown_units_are_scaled_and_asked_for(ct, tmp_path):
    path, volume = tmp_path / "t.dcm", mph.Volume(ct.array + 1000, ct.grid)
    for code in ("{counts}", "g/ml{SUVbw}"):
        mapped = [dicom_files.real_world_values(0.5, 0.0, code)]
        stored = (dicom_files.write_tomogram(volume, path, RealWorldValueMappingSequence=mapped), volume.array)[1] - 1
        refused(lambda: mph.read_volume(path), "say which quantity")
        np.testing.assert_allclose(mph.read_volume(path, "activity").array, 0.5 * stored / 2, atol=0.26)
        refused(lambda: mph.read_volume(path, "hu"), "expected hu in HU")
    two = [dicom_files.real_world_values(slope, 0.0, "Bq/ml") for slope in (1.0, 2.0)]
    dicom_files.write_tomogram(volume, path, RealWorldValueMappingSequence=two)
    refused(lambda: mph.read_volume(path), "1 x value + 0 Bq/ml; 2 x value + 0 Bq/ml; expected one of them")


@pytest.mark.parametrize("first, last", [(0, 100), (1700, 65535), (500, 1000)])
def test_a_map_of_a_part_of_the_values_is_refused(ct, tmp_path, first, last):
    mapped = dicom_files.real_world_values(0.5, 0.0, "Bq/ml")
    dicom_files.set_tags(mapped, RealWorldValueFirstValueMapped=first, RealWorldValueLastValueMapped=last)
    volume = mph.Volume(2 * (ct.array + 1000) + 1, ct.grid)
    dicom_files.write_tomogram(volume, tmp_path / "t.dcm", RealWorldValueMappingSequence=[mapped])
    refused(lambda: mph.read_volume(tmp_path / "t.dcm"), f"of stored values {first} to {last}, found")


def series(ct: mph.Volume, folder: Path, edit=lambda data, k: None, **options) -> Path:
    """Write a CT as a series of slices, each changed by `edit`; return the folder."""
    for k, data in enumerate(dicom_files.write_series(ct, folder, **options)):
        edit(data, k)
        dicom_files.save(data)
    return folder


@pytest.mark.parametrize("kind", ["Z_EFF", "EDW", "MGML", "PCT", "OD"])
def test_a_ct_of_other_values_is_no_ct_in_hu(ct, tmp_path, kind):
    folder = series(ct, tmp_path / "a", lambda data, k: setattr(data, "RescaleType", kind))
    refused(lambda: mph.read_volume(folder), f"it holds 'CT in {kind}'")
    refused(lambda: mph.read_volume(folder, "hu"), f"it holds CT in {kind}, expected hu")


@pytest.mark.parametrize("slices", [[0], [3, 4], range(1, 7)])
def test_slices_of_which_some_have_no_rescaling_are_refused(ct, tmp_path, slices):
    folder = series(ct, tmp_path / "a", lambda data, k: k in slices and data.__delattr__("RescaleSlope"))
    refused(lambda: mph.read_volume(folder), "RescaleSlope, unlike")


def enhanced(ct: mph.Volume, path: Path, change=lambda frame, k: None, at_the_top: bool = False) -> Path:
    """Write a CT as one enhanced file, whose frames `change` changes."""
    affine, spacing = dicom_files.LPS @ ct.grid.affine, ct.grid.spacing

    def item(**tags) -> Dataset:
        return dicom_files.set_tags(Dataset(), **tags)

    rescaling = {"RescaleSlope": 1, "RescaleIntercept": -1024, "RescaleType": "HU"}
    texts = dicom_files.numbers
    shared = item(
        PixelMeasuresSequence=[item(PixelSpacing=texts(spacing[1::-1]), SliceThickness=texts(spacing[2:])[0])],
        PlaneOrientationSequence=[item(ImageOrientationPatient=texts((affine[:3, :2] / spacing[:2]).T.ravel()))],
    )
    if not at_the_top:
        shared.PixelValueTransformationSequence = [item(**rescaling)]
    frames = []
    for k in range(ct.grid.shape[2]):
        place = item(ImagePositionPatient=texts((affine @ [0, 0, k, 1])[:3]))
        frames.append(item(PlanePositionSequence=[place]))
        change(frames[-1], k)
    data = dicom_files.new_dataset(
        EnhancedCTImageStorage, Modality="CT", SeriesInstanceUID="1.2.3", Rows=ct.grid.shape[1], Columns=ct.grid.shape[0],
        NumberOfFrames=len(frames), SharedFunctionalGroupsSequence=[shared], PerFrameFunctionalGroupsSequence=frames,
        PixelData=(ct.array + 1024).transpose(2, 1, 0).astype("<u2").tobytes(), **(rescaling if at_the_top else {}),
    )  # fmt: skip
    data.filename = str(path)
    dicom_files.save(data)
    return path


@pytest.mark.parametrize("tags", [
    {"ImagePositionPatient": ["1", "2", "3"]}, {"PixelSpacing": ["3", "3"]},
    {"RescaleSlope": "4.2", "RescaleIntercept": "0"},
    {"ImageOrientationPatient": ["0", "1", "0", "1", "0", "0"]},
])  # fmt: skip
@pytest.mark.parametrize("group, creator", [(0x2005, "Philips MR Imaging DD 005"), (0x0021, "SOMEONE 1.0")])
def test_private_sequences_are_no_functional_groups(ct, tmp_path, tags, group, creator):
    def change(frame: Dataset, k: int) -> None:
        private = dicom_files.set_tags(Dataset(), **tags)
        frame.private_block(group, creator, create=True).add_new(0x0F, "SQ", [private])

    same(mph.read_volume(enhanced(ct, tmp_path / "e.dcm", change)), ct)


def test_an_enhanced_file_may_be_rescaled_at_the_top_and_is_read_alone(ct, tmp_path):
    path = enhanced(ct, tmp_path / "e.dcm", at_the_top=True)
    same(mph.read_volume(path), ct)
    enhanced(ct, tmp_path / "other.dcm")
    same(mph.read_volume(path), ct)


def bare(path: Path) -> None:
    path.write_bytes(path.read_bytes()[132:])


@pytest.mark.parametrize("slices", [[6], [0], [2, 3]])
def test_slices_without_prefix_or_ending_are_slices(ct, tmp_path, slices):
    folder = series(ct, tmp_path / "a", names=[f"IM{k}" for k in range(7)])
    for k in slices:
        bare(folder / f"IM{k}")
    (folder / "._IM0").write_bytes(b"\0\5\x16\7 of macOS")
    (folder / "notes.txt").write_text("Thorax")
    same(mph.read_volume(folder), ct)


@pytest.mark.parametrize("k", [0, 3, 6])
def test_a_packed_slice_is_not_left_out(ct, tmp_path, k):
    folder = series(ct, tmp_path / "a")
    path = folder / f"1-{k:04d}.dcm"
    path.with_suffix(".dcm.gz").write_bytes(gzip.compress(path.read_bytes()))
    path.unlink()
    refused(lambda: mph.read_volume(folder), f"1-{k:04d}.dcm.gz: it is packed: unpack it first")


def test_the_root_of_a_disc_says_where_its_series_are(ct, tmp_path):
    disc = tmp_path / "disc"
    disc.mkdir()
    for name in ("ST0/SE0", "ST0/SE1"):
        (disc / name).parent.mkdir(exist_ok=True)
        series(ct, disc / name)
    refused(lambda: mph.read_volume(disc), "folders with DICOM files in it: ST0/SE0, ST0/SE1")


def test_series_of_one_number_and_name_are_told_apart(ct, tmp_path):
    folder = series(ct, tmp_path / "a")
    written = dicom_files.write_series(mph.Volume(ct.array + 10, ct.grid, "hu"), tmp_path / "b")
    for data in written:
        shutil.copy(data.filename, folder / f"b{Path(data.filename).name}")
    uid = written[0].SeriesInstanceUID
    refused(lambda: mph.read_volume(folder), f"it holds 2 series, .*{uid}")
    np.testing.assert_allclose(mph.read_volume(folder, series=uid).array, ct.array + 10)


@pytest.mark.parametrize("angle", [-24.0, 3.0, 15.0])
def test_a_tilted_stack_is_a_sheared_grid(ct, tmp_path, angle):
    affine = np.array(ct.grid.affine)
    affine[:3, 2] += (
        np.tan(np.radians(angle)) * np.linalg.norm(affine[:3, 2]) * affine[:3, 1] / np.linalg.norm(affine[:3, 1])
    )
    tilted = mph.Volume(ct.array, mph.Grid(ct.grid.shape, affine), "hu")
    folder = series(tilted, tmp_path / "a", lambda data, k: setattr(data, "GantryDetectorTilt", str(angle)))
    same(mph.read_volume(folder), tilted)
    same(mph.read_volume(series(ct, tmp_path / "b", lambda data, k: setattr(data, "GantryDetectorTilt", "5"))), ct)


@pytest.mark.parametrize("step, digits", [(1.25, 1), (2.4999, 2), (0.625, 2), (3.3333, 1)])
def test_places_in_few_digits_are_even(ct, tmp_path, step, digits):
    affine = np.diag([1.0, 1.0, step, 1.0])
    even = mph.Volume(ct.array, mph.Grid(ct.grid.shape, affine), "hu")

    def rounded(data: Dataset, k: int) -> None:
        data.ImagePositionPatient = [f"{float(x):.{digits}f}" for x in data.ImagePositionPatient]

    same(mph.read_volume(series(even, tmp_path / "a", rounded)), even, 0.5 * 0.1**digits)


@pytest.mark.parametrize("at, factor", [(3, 2.0), (2, 1.5), (4, 0.5)])
def test_a_step_that_changes_is_no_missing_slice(ct, tmp_path, at, factor):
    flat = mph.Volume(ct.array, mph.Grid(ct.grid.shape, np.diag([1.0, 1.0, 2.0, 1.0])), "hu")

    def moved(data: Dataset, k: int) -> None:
        data.ImagePositionPatient = ["0", "0", str(2.0 * min(k, at) + 2.0 * factor * max(0, k - at))]

    folder = series(flat, tmp_path / "a", moved)
    refused(lambda: mph.read_volume(folder), "the distance of the slices changes between")


@pytest.mark.parametrize("shift, scale", [(1024, 1.0), (1000, 0.1275), (1000, 1.0)])
def test_numbers_without_air_are_doubted_as_ct_numbers(ct, shift, scale):
    assert not any("CT numbers?" in text for text in warned(lambda: mph.hu_to_mu(ct)))
    grey = mph.Volume(scale * (ct.array + shift), ct.grid, "hu")
    assert any("no value is below -500 HU" in text for text in warned(lambda: mph.hu_to_mu(grey)))


@pytest.mark.parametrize("bits, high", [(12, 15), (10, 12), (8, 11)])
def test_numbers_in_high_bits_are_refused(ct, tmp_path, bits, high):
    folder = series(ct, tmp_path / "a", lambda data, k: dicom_files.set_tags(data, BitsStored=bits, HighBit=high))
    refused(lambda: mph.read_volume(folder), f"HighBit {high}: expected {bits - 1}")


@pytest.mark.parametrize("code", ["mg/cm3", "{effective atomic number}", "g/ml{SUVbw}"])
@pytest.mark.parametrize("kind", ["HU", "US", None])
def test_a_map_to_another_quantity_leaves_ct_numbers_ct_numbers(ct, tmp_path, kind, code):
    tags = {"RescaleType": kind, "RealWorldValueMappingSequence": [dicom_files.real_world_values(7.0, 1.0, code)]}
    same(mph.read_volume(series(ct, tmp_path / "a", lambda data, k: dicom_files.set_tags(data, **tags))), ct)
    tags["RealWorldValueMappingSequence"] = [dicom_files.real_world_values(7.0, 1.0, "[hnsf'U]")]
    folder = series(ct, tmp_path / "b", lambda data, k: dicom_files.set_tags(data, **tags))
    refused(lambda: mph.read_volume(folder), "its rescaling is .* HU, RealWorldValueMapping 7 x value")
