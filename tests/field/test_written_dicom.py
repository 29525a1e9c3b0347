"""Volumes written as DICOM: values, place, tags and the attributes that the standard requires.

https://github.com/PyTomography/PyTomography/issues/230 (rescaling that does not read back) and 158 (rotation information),
https://github.com/UCL/STIR/issues/1123 (readers that know no real-world values),
https://github.com/rordenlab/dcm2niix/issues/885 and https://github.com/OHIF/Viewers/issues/4352 (sign of the spacing).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main

from ..core.conftest import WORKBOOK

pydicom = pytest.importorskip("pydicom")

TO_FILE = {"activity": 1e3, "mu": 10.0, "hu": 1.0}
"""Factors to the units in the file: Bq/mL, 1/cm and HU."""
TYPE_2 = {
    "NM": {
        "PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime", "ReferringPhysicianName",
        "StudyID", "AccessionNumber", "SeriesNumber", "PatientOrientationCodeSequence", "InstanceNumber", "Manufacturer",
        "PatientGantryRelationshipCodeSequence", "CountsAccumulated", "EnergyWindowInformationSequence",
        "RadiopharmaceuticalInformationSequence", "DetectorInformationSequence", "RotationInformationSequence",
        "SpacingBetweenSlices", "SliceThickness", "FrameIncrementPointer", "NumberOfEnergyWindows", "NumberOfDetectors",
        "SliceVector", "NumberOfSlices", "PositionReferenceIndicator", "FrameOfReferenceUID",
    },
    "CT": {
        "PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime", "ReferringPhysicianName",
        "StudyID", "AccessionNumber", "SeriesNumber", "FrameOfReferenceUID", "PositionReferenceIndicator", "KVP",
        "Manufacturer", "InstanceNumber", "PatientPosition", "SliceThickness", "AcquisitionNumber", "RescaleSlope",
        "RescaleIntercept", "ImageType",
    },
}  # fmt: skip
"""Attributes of types 1 and 2 of the modules of both kinds of images (DICOM part 3, A.3 and A.5)."""


def made(rng: np.random.Generator, quantity: str, mirrored: bool = False, signed: bool = False) -> mph.Volume:
    """Return a small volume of random values on an oblique grid."""
    affine = mph.euler_pose(0.2, -0.1, 0.3) @ np.diag([1.25, 1.5, -2.75 if mirrored else 2.75, 1.0])
    affine[:3, 3] = [-20.123, 35.5, -60]
    values = rng.random((6, 5, 7)) - 0.5 * signed
    scale = {"activity": 40.0, "mu": 0.02, "hu": 900.0}[quantity]
    return mph.Volume(scale * values, mph.Grid(values.shape, affine), quantity)


def at_same_places(volume: mph.Volume, affine: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return those of the `values` with an `affine` that lie at the volume's voxels; check that all do."""
    index = np.indices(volume.grid.shape).reshape(3, -1)
    world = volume.grid.affine[:3, :3] @ index + volume.grid.affine[:3, 3:]
    place = np.linalg.solve(affine[:3, :3], world - affine[:3, 3:])
    np.testing.assert_allclose(place, np.rint(place), atol=1e-7)
    return values[tuple(np.rint(place).astype(int))].reshape(volume.grid.shape)


def first_file(path: Path) -> Path:
    """Return the only file, or the first of a series."""
    return sorted(path.iterdir())[0] if path.is_dir() else path


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("quantity", TO_FILE)
def test_dicom_reads_back_to_16_bits_at_its_place(rng, tmp_path, quantity, mirrored, signed):
    volume, path = made(rng, quantity, mirrored, signed), tmp_path / "v.dcm"
    mph.write_volume(volume, path)
    read = mph.read_volume(path)
    assert read.quantity == quantity
    half_step = np.abs(volume.array).max() / (32767 if signed else 65535) * 0.501
    values = at_same_places(volume, read.grid.affine, read.array)
    np.testing.assert_allclose(values, volume.array, atol=half_step)
    sitk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed")
    names = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(path)) if path.is_dir() else str(path)
    image = sitk.ReadImage(names)
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    affine = np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
    values = at_same_places(volume, affine, sitk.GetArrayFromImage(image).T) / TO_FILE[quantity]
    np.testing.assert_allclose(values, volume.array, atol=half_step)


def test_frames_follow_the_normal_by_the_spacing_between_slices(rng, tmp_path):
    for mirrored in (False, True):
        volume, path = made(rng, "activity", mirrored), tmp_path / "v.dcm"
        mph.write_volume(volume, path)
        data = pydicom.dcmread(path)
        detector = data.DetectorInformationSequence[0]
        along = np.reshape(detector.ImageOrientationPatient, (2, 3))
        last = np.array(detector.ImagePositionPatient) + 6 * float(data.SpacingBetweenSlices) * np.cross(*along)
        index = np.linalg.inv(volume.grid.affine) @ [*last * [-1, -1, 1], 1.0]
        np.testing.assert_allclose(index[:3], [0, 0, 0 if mirrored else 6], atol=1e-9)
        assert list(data.SliceVector) == [1, 2, 3, 4, 5, 6, 7]
        values = data.pixel_array[6].T * float(data.RescaleSlope)
        np.testing.assert_allclose(values, 1e3 * volume.array[:, :, round(index[2])], atol=0.4)


@pytest.mark.parametrize("values", [[-1000, 3071], [0, 65535], [-3, 7], [0, 0]])
def test_whole_numbers_are_stored_exactly(tmp_path, values):
    array = np.resize(np.array(values, np.float32), (3, 3, 2))
    for quantity in ("hu", "activity"):
        path = tmp_path / f"{quantity}{values}.dcm"
        mph.write_volume(mph.Volume(array, mph.Grid.centered((3, 3, 2), 2.0), quantity), path)
        np.testing.assert_array_equal(mph.read_volume(path).array, array)


@pytest.mark.parametrize("quantity, modality", [("activity", "NM"), ("mu", "NM"), ("hu", "CT")])
def test_files_have_what_the_standard_requires(rng, tmp_path, quantity, modality):
    mph.write_volume(made(rng, quantity), tmp_path / "v.dcm")
    data = pydicom.dcmread(first_file(tmp_path / "v.dcm"))
    assert data.Modality == modality
    assert TYPE_2[modality] <= set(data.dir())
    if modality == "NM":
        (mapped,) = data.RealWorldValueMappingSequence
        assert mapped.MeasurementUnitsCodeSequence[0].CodeValue == {"activity": "Bq/mL", "mu": "/cm"}[quantity]
        assert float(mapped.RealWorldValueSlope) == float(data.RescaleSlope)


def test_tags_come_from_the_template_and_the_user(rng, tmp_path):
    mph.write_volume(made(rng, "hu"), tmp_path / "ct.dcm", tags={"PatientName": "Å^Jo"})
    template = first_file(tmp_path / "ct.dcm")
    source = pydicom.dcmread(template)
    source.SpecificCharacterSet = "ISO_IR 100"
    source.PatientName, source.PatientWeight, source.BodyPartExamined = "Åström^Jo", 71.5, "HEART"
    source.StudyDate, source.SeriesDescription, source.KVP = "20260305", "Thorax", 120
    source.save_as(template)
    tags = {"SeriesDescription": "OSEM 10 x 8", "SeriesNumber": 7}
    mph.write_volume(made(rng, "activity"), tmp_path / "a.dcm", template=template, tags=tags)
    data = pydicom.dcmread(tmp_path / "a.dcm")
    assert (str(data.PatientName), data.PatientWeight, data.StudyDate) == ("Åström^Jo", 71.5, "20260305")
    assert (data.SeriesDescription, data.SeriesNumber, data.BodyPartExamined) == ("OSEM 10 x 8", 7, "HEART")
    assert data.StudyInstanceUID == source.StudyInstanceUID
    for keyword in ("SOPInstanceUID", "SeriesInstanceUID", "FrameOfReferenceUID"):
        assert data[keyword].value != source[keyword].value
    assert "KVP" not in data and data.Rows == 5


def test_rotations_and_radiopharmaceuticals_come_from_a_template(rng, tmp_path):
    mph.write_volume(made(rng, "activity"), tmp_path / "t.dcm")
    source = pydicom.dcmread(tmp_path / "t.dcm")
    rotation, drug = pydicom.Dataset(), pydicom.Dataset()
    rotation.StartAngle, rotation.AngularStep, rotation.ScanArc = 12, 3, 180
    rotation.RotationDirection, rotation.ActualFrameDuration, rotation.NumberOfFramesInRotation = "CW", 20000, 60
    drug.Radiopharmaceutical = "Tetrofosmin"
    source.RotationInformationSequence, source.RadiopharmaceuticalInformationSequence = [rotation], [drug]
    source.save_as(tmp_path / "t.dcm")
    mph.write_volume(made(rng, "activity"), tmp_path / "a.dcm", template=tmp_path / "t.dcm")
    data = pydicom.dcmread(tmp_path / "a.dcm")
    assert data.RotationInformationSequence == source.RotationInformationSequence
    assert data.RadiopharmaceuticalInformationSequence[0].Radiopharmaceutical == "Tetrofosmin"
    assert mph.read_volume(tmp_path / "a.dcm").quantity == "activity"
    source.RotationInformationSequence = [rotation, rotation]  # a tomogram has one
    source.save_as(tmp_path / "t.dcm")
    mph.write_volume(made(rng, "activity"), tmp_path / "a.dcm", template=tmp_path / "t.dcm")
    assert not pydicom.dcmread(tmp_path / "a.dcm").RotationInformationSequence


REFUSED_TAGS = [
    ({"Rows": 3}, "tag Rows: expected one of patient"),
    ({"PixelSpacing": [1, 1]}, "tag PixelSpacing"),
    ({"Nonsense": "x"}, "tag Nonsense"),
    ({"SeriesNumber": "seven"}, "tag SeriesNumber"),
    ({"PatientBirthDate": "5 March"}, "tag PatientBirthDate"),
]


@pytest.mark.parametrize("tags, words", REFUSED_TAGS)
def test_tags_that_are_no_tags_of_a_patient_are_refused(rng, tmp_path, tags, words):
    with pytest.raises(mph.InputError, match=words):
        mph.write_volume(made(rng, "mu"), tmp_path / "v.dcm", tags=tags)
    assert not list(tmp_path.iterdir())


def test_what_dicom_cannot_hold_is_refused(rng, tmp_path):
    volume = made(rng, "activity")
    for column, row, shear in ((1, 0, 0.2), (2, 1, 0.001), (2, 0, -0.05)):
        affine = volume.grid.affine.copy()
        affine[:3, column] += shear * affine[:3, row]
        with pytest.raises(mph.InputError, match="sheared"):
            mph.write_volume(mph.Volume(volume.array, mph.Grid(volume.grid.shape, affine), "hu"), tmp_path / "v.dcm")
    for quantity in ("dose", "sensitivity", "resolution"):
        with pytest.raises(mph.InputError, match=f"not {quantity}"):
            mph.write_volume(mph.Volume(volume.array, volume.grid, quantity), tmp_path / "v.dcm")
    with pytest.raises(mph.InputError, match="only DICOM has a template and tags"):
        mph.write_volume(volume, tmp_path / "v.nii", tags={"PatientID": "3"})
    (tmp_path / "no.dcm").write_bytes(b"no DICOM")
    with pytest.raises(mph.InputError, match=r"no\.dcm: cannot be read as DICOM"):
        mph.write_volume(volume, tmp_path / "v.dcm", template=tmp_path / "no.dcm")
    assert [path.name for path in tmp_path.iterdir()] == ["no.dcm"]


def test_the_command_line_writes_tags(rng, tmp_path, capsys):
    mph.write_volume(made(rng, "activity"), tmp_path / "v.npz")
    mph.write_volume(made(rng, "hu"), tmp_path / "ct.dcm", tags={"PatientID": "42"})
    convert = ["volume", "convert", str(tmp_path / "v.npz"), "-o", str(tmp_path / "v.dcm")]
    assert main([*convert, "--template", str(tmp_path / "ct.dcm/0001.dcm"), "--tag", "PatientName=Doe^Jo"]) == 0
    data = pydicom.dcmread(tmp_path / "v.dcm")
    assert (str(data.PatientName), data.PatientID) == ("Doe^Jo", "42")
    assert main([*convert, "--tag", "PatientName"]) != 0
    assert "expected KEYWORD=VALUE" in capsys.readouterr().err


def test_a_note_of_the_volume_is_kept(rng, tmp_path):
    volume = made(rng, "activity")
    mph.write_volume(mph.Volume(volume.array, volume.grid, "activity", "made by a network"), tmp_path / "v.dcm")
    assert pydicom.dcmread(tmp_path / "v.dcm").ImageComments == "made by a network"


@pytest.mark.parametrize("detector", ["virtual", "real"])
@pytest.mark.parametrize("time", [600.0, 0.25])
def test_counts_read_back_with_time_window_and_pixels(rng, tmp_path, detector, time):
    modules = mph.read_system(WORKBOOK)[np.array([0, 7, 79])]
    model = mph.Emission(modules, time=time, isotope="Tc-99m", window=(130.0, 151.5))
    volume = mph.Volume(rng.random((8, 8, 8)) * 1e4 / time, mph.Grid.centered(8, 4.0), "activity")
    run = mph.project_run(modules, volume, (16, 12), detector, model=model, noise_seed=3)
    mph.write_counts(run, tmp_path / "c.dcm", tags={"PatientID": "phantom"})
    counts = mph.read_counts(tmp_path / "c.dcm")
    again = mph.counts_run(counts, modules, [int(n) for n in modules.numbers], "back-v", detector=detector)
    np.testing.assert_array_equal(again.projections, run.projections)
    assert again.recipe["model.time"] == time
    np.testing.assert_allclose(counts.about[:, 5:], [[130.0, 151.5]] * 3)
    assert pydicom.dcmread(tmp_path / "c.dcm").PatientID == "phantom"
    mph.write_run(again, tmp_path / "again.dcm")
    np.testing.assert_array_equal(mph.read_counts(tmp_path / "again.dcm"), counts)


def test_runs_that_are_no_planar_image_are_refused(rng, tmp_path):
    modules = mph.read_system(WORKBOOK)[np.array([0, 7])]
    volume = mph.Volume(rng.random((8, 8, 8)), mph.Grid.centered(8, 4.0), "activity")
    fast = mph.Emission(modules, time=0.0005)
    runs = {
        "expected a run of counts": mph.project_run(modules, volume, (8, 8)),
        "exposure in whole milliseconds": mph.project_run(modules, volume, (8, 8), model=fast),
    }
    for words, run in runs.items():
        with pytest.raises(mph.InputError, match=words):
            mph.write_counts(run, tmp_path / "c.dcm")
    with pytest.raises(mph.InputError, match=r"c\.h5: expected a name ending in \.dcm"):
        mph.write_counts(run, tmp_path / "c.h5")
    assert not list(tmp_path.iterdir())
