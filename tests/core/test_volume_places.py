"""Voxel positions by a header's fields: each is used, refused or warned about, and SimpleITK agrees."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import mphdrr.core as mph

from .dicom_files import LPS
from .test_volume_formats import write_meta_image

try:
    import SimpleITK as itk
except ImportError:  # if it is installed, its positions are compared too
    itk = None

SIZES = (2, 3, 4)
VALUES = np.arange(24, dtype="<f4").reshape(SIZES, order="F")
DIRECTIONS = {"space": "LPS", "space directions": "(0,2,0) (-1,0,0) (0,0,3)", "space origin": "(5,6,7)"}
ORTHOGONAL = np.diag([1.0, 2, 3, 1])


def at(origin, scale: float = 1.0) -> np.ndarray:
    affine = ORTHOGONAL.copy()
    affine[:3] *= scale
    affine[:3, 3] = origin
    return affine


def write_nrrd(path, data: bytes | None = None, **fields: str):
    lines = {"type": "float", "dimension": "3", "sizes": "2 3 4", "encoding": "raw", "endian": "little", **fields}
    header = "NRRD0005\n" + "".join(f"{name}: {value}\n" for name, value in lines.items() if value)
    path.write_bytes(header.encode() + b"\n" + (VALUES.tobytes(order="F") if data is None else data))
    return path


def read(path) -> tuple[mph.Volume, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        volume = mph.read_volume(path)
    return volume, [str(w.message) for w in caught if issubclass(w.category, mph.InputWarning)]


MINS = {"spacings": "1 2 3", "axis mins": "10 20 30"}
# Fields of the axes, index to mm, and whether something about the voxels had to be assumed.
OF_AXES = {
    "cells": ({**MINS, "centerings": "cell cell cell"}, at((10.5, 21, 31.5)), False),
    "cells, by the other names": (
        {"spacings": "1 2 3", "axismins": "10 20 30", "centers": "cell cell cell"}, at((10.5, 21, 31.5)), False),
    "nodes": ({**MINS, "centerings": "node node node"}, at((10, 20, 30)), False),
    "both": ({**MINS, "centerings": "node cell node"}, at((10, 21, 30)), False),
    "not said, as in teem": (MINS, at((10.5, 21, 31.5)), True),
    "between faces": (
        {"axis mins": "10 20 30", "axis maxs": "12 26 42", "centerings": "cell cell cell"}, at((10.5, 21, 31.5)), False),
    "between nodes": (
        {"axis mins": "10 20 30", "axis maxs": "11 24 39", "centerings": "node node node"}, at((10, 20, 30)), False),
    "mirrored": (
        {"axis mins": "12 26 42", "axis maxs": "10 20 30", "centerings": "cell cell cell"},
        at((11.5, 25, 40.5)) @ np.diag([-1.0, -1, -1, 1]), False),
    "spacings alone": ({"spacings": "1 2 3"}, at((0, 0, 0)), True),
    "nothing": ({}, np.eye(4), True),
    "thicknesses and a frame say nothing of places": (
        {**MINS, "centerings": "cell cell cell", "thicknesses": "9 9 9", "kinds": "domain domain domain"},
        at((10.5, 21, 31.5)), False),
}  # fmt: skip


@pytest.mark.parametrize("case", OF_AXES)
def test_axes_lie_where_the_format_says_and_itk_puts_them(tmp_path, case):
    fields, expected, assumed = OF_AXES[case]
    volume, said = read(write_nrrd(tmp_path / "v.nrrd", **fields))
    np.testing.assert_allclose(volume.grid.affine, expected)
    assert np.array_equal(volume.array, VALUES)
    assert said and "axes right, anterior, superior" in said[0]  # the space has no name
    assert ("voxel" in said[0]) == assumed
    if itk is None or (fields and "spacings" not in fields):
        return  # by the definition of the format alone: of mins and maxs ITK takes 1 mm
    image = itk.ReadImage(str(tmp_path / "v.nrrd"))
    for index in ((0, 0, 0), (1, 2, 3)):
        place = volume.grid.affine @ [*index, 1]
        np.testing.assert_allclose(place[:3], image.TransformIndexToPhysicalPoint(index))


def test_space_directions_lie_where_itk_puts_them(tmp_path):
    turned = np.array([[0, -1, 0, 5], [2, 0, 0, 6], [0, 0, 3, 7], [0, 0, 0, 1.0]])
    for fields in (
        DIRECTIONS,
        {**DIRECTIONS, "space": "RAS", "measurement frame": "(0,1,0) (1,0,0) (0,0,1)"},
        {**DIRECTIONS, "centerings": "node node node"},  # the origin is the first voxel's centre all the same
        {**DIRECTIONS, "byte skip": "-1"},
    ):
        volume, said = read(write_nrrd(tmp_path / "v.nrrd", **fields))
        assert said == [] and np.array_equal(volume.array, VALUES)
        np.testing.assert_allclose(volume.grid.affine, (LPS if fields["space"] == "LPS" else np.eye(4)) @ turned)
        if itk is None:
            continue
        image = itk.ReadImage(str(tmp_path / "v.nrrd"))
        assert np.array_equal(itk.GetArrayFromImage(image).T, volume.array)
        for index in ((0, 0, 0), (1, 2, 3)):
            place = LPS @ volume.grid.affine @ [*index, 1]
            np.testing.assert_allclose(place[:3], image.TransformIndexToPhysicalPoint(index))


def test_units_of_the_axes_and_of_the_space(tmp_path):
    inches = {"spacings": "0.1 0.2 0.3", "axis mins": "1 2 3", "centerings": "node node node"}
    for unit, scale in (("cm", 1.0), ("m", 100.0), ("um", 1e-4)):
        volume, _ = read(write_nrrd(tmp_path / "v.nrrd", **inches, units=f'"{unit}" "{unit}" "{unit}"'))
        np.testing.assert_allclose(volume.grid.affine, at((10 * scale, 20 * scale, 30 * scale), scale))
        both = {"space": "RAS", "spacings": "1 2 3", "space origin": "(1,2,3)", "units": '"mm" "mm" "mm"'}
        volume, _ = read(write_nrrd(tmp_path / "v.nrrd", **both, **{"space units": f'"{unit}" "{unit}" "{unit}"'}))
        np.testing.assert_allclose(volume.grid.affine, at((10 * scale, 20 * scale, 30 * scale)))
    volume, _ = read(write_nrrd(tmp_path / "v.nrrd", **DIRECTIONS, units='"cm" "cm" "cm"'))
    assert volume.grid.spacing.tolist() == [20, 10, 30]


@pytest.mark.parametrize("detached", [False, True])
def test_skipped_lines_and_bytes(tmp_path, detached):
    data = b"one\ntwo\nxyz" + VALUES.tobytes(order="F")
    fields = {**DIRECTIONS, "line skip": "2", "byte skip": "3"}
    if detached:
        (tmp_path / "v.raw").write_bytes(data)
        path = write_nrrd(tmp_path / "v.nhdr", b"", **fields, **{"data file": "v.raw"})
    else:
        path = write_nrrd(tmp_path / "v.nrrd", data, **fields)
    assert np.array_equal(read(path)[0].array, VALUES)


REFUSED = {
    "two places": (
        {**MINS, "space": "RAS", "centerings": "cell cell cell", "space origin": "(10,20,30)"},
        "axis mins and space origin say different places: 10.5 21 31.5 and 10 20 30",
    ),
    "mins beside directions": ({**DIRECTIONS, "axis mins": "1 2 3"}, "axis mins or axis maxs beside space directions"),
    "maxs beside directions": ({**DIRECTIONS, "axis maxs": "1 2 3"}, "axis mins or axis maxs beside space directions"),
    "two lengths": ({**DIRECTIONS, "spacings": "2 1 4"}, "spacings and space directions say different lengths"),
    "two lengths of axes": (
        {**MINS, "axis maxs": "13 26 42", "centerings": "cell cell cell"}, "say different lengths: 1 2 3 and 1.5 2 3"),
    "maxs alone": ({"axis maxs": "1 2 3"}, "axis maxs: expected axis mins beside them"),
    "some spacings": ({"spacings": "1 2 nan"}, "spacings: expected 3 numbers, got 1 2 nan"),
    "some mins": ({"spacings": "1 2 3", "axis mins": "1 nan 3"}, "axis mins: expected 3 numbers, got 1 nan 3"),
    "unknown centering": ({**MINS, "centerings": "cell cell edge"}, "centerings cell cell edge: expected cell or node"),
    "inches": ({"spacings": "1 2 3", "units": '"in" "in" "in"'}, "units in in in: expected mm, cm, m or um"),
    "parsecs": ({**DIRECTIONS, "space units": '"pc" "pc" "pc"'}, "space units pc pc pc: expected mm, cm, m or um"),
    "two units": (
        {**DIRECTIONS, "space units": '"mm" "mm" "mm"', "units": '"cm" "cm" "cm"'}, "units: the axes' own differ"),
    "an axis of time": ({**DIRECTIONS, "kinds": "domain domain time"}, "kinds domain domain time: expected three axes"),
    "an axis of colours": (
        {**DIRECTIONS, "space directions": "none (1,0,0) (0,1,0)"}, "space directions: expected a vector for each"),
    "quantized": (
        {**DIRECTIONS, "type": "int", "old min": "0", "old max": "5"}, "old min and old max: quantized values"),
    "several files": ({**DIRECTIONS, "data file": "v%02d.raw 0 3 1"}, "voxels in several files are not read"),
    "a list of files": ({**DIRECTIONS, "data file": "LIST 2"}, "data file: LIST 2: voxels in several files"),
    "capitals": ({"Spacings": "1 2 3"}, "field 'Spacings': expected it in small letters"),
    "other values": ({**DIRECTIONS, "sample units": "1/cm"}, "its values are in 1/cm; expected HU"),
    "a nameless space": ({**DIRECTIONS, "space": "left-handed"}, "space 'left-handed': expected"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_nrrd_that_says_two_things_or_none_is_refused_in_one_line(tmp_path, case):
    fields, expected = REFUSED[case]
    with pytest.raises(mph.InputError) as caught:
        read(write_nrrd(tmp_path / "v.nrrd", **fields))
    assert expected in str(caught.value) and "\n" not in str(caught.value)


def test_statements_that_agree_are_read(tmp_path):
    same = {**DIRECTIONS, "spacings": "2 1 3", "units": '"mm" "mm" "mm"', "axis mins": "nan nan nan"}
    volume, said = read(write_nrrd(tmp_path / "v.nrrd", **same, **{"sample units": "Hounsfield units"}))
    assert said == [] and volume.grid.spacing.tolist() == [2, 1, 3]
    twice = {**MINS, "centerings": "cell cell cell", "axis maxs": "12 26 42", "space": "RAS"}
    volume, said = read(write_nrrd(tmp_path / "v.nrrd", **twice, **{"space origin": "(10.5,21,31.5)"}))
    assert said == [] and np.allclose(volume.grid.affine, at((10.5, 21, 31.5)))


def write_meta(path, **changes: str):
    usual = {"ElementType": "MET_FLOAT", "Offset": "1 2 3", "ElementSpacing": "1 2 3", "TransformMatrix": ""}
    write_meta_image(path, VALUES, **usual | changes)
    return path


def test_units_and_missing_fields_of_meta_images(tmp_path):
    path = tmp_path / "v.mha"
    for unit, scale in (("mm", 1.0), ("cm", 10.0), ("um", 1e-3)):
        volume, said = read(write_meta(path, DistanceUnits=unit))
        assert said == []
        np.testing.assert_allclose(volume.grid.affine, LPS @ at(scale * np.array([1.0, 2, 3]), scale))
    _, said = read(write_meta(path, ElementSpacing=""))
    assert "voxels of 1 mm" in said[0]
    _, said = read(write_meta(path, Offset=""))
    assert "the first voxel's centre at (0, 0, 0)" in said[0]
    for changes, message in (
        ({"DistanceUnits": "in"}, "DistanceUnits = in: expected mm, cm or um"),
        ({"AnatomicalOrientation": "LPS"}, "AnatomicalOrientation = LPS without a TransformMatrix"),
        ({"ElementToIntensityFunctionSlope": "0.5"}, "ElementToIntensityFunctionSlope = 0.5: values that are to be"),
        ({"ElementToIntensityFunctionOffset": "-1024"}, "ElementToIntensityFunctionOffset = -1024"),
    ):
        with pytest.raises(mph.InputError, match=message):
            read(write_meta(path, **changes))


def test_units_and_two_places_of_nifti_and_analyze(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    for unit, scale in (("mm", 1.0), ("meter", 1e3), ("micron", 1e-3), ("unknown", 1.0)):
        image = nibabel.Nifti1Image(VALUES, at((4, 5, 6)))
        image.header.set_xyzt_units(unit)
        nibabel.save(image, tmp_path / "v.nii")
        volume, said = read(tmp_path / "v.nii")
        assert said == [] and np.allclose(volume.grid.affine, at(scale * np.array([4.0, 5, 6]), scale))
        assert volume.quantity == "hu"
    for moved, told in ((0.0, 0), (0.5, 1)):
        image = nibabel.Nifti1Image(VALUES, at((4, 5, 6)))
        image.set_qform(at((4 + moved, 5, 6)), 1)
        nibabel.save(image, tmp_path / "v.nii")
        volume, said = read(tmp_path / "v.nii")
        assert len(said) == told and np.allclose(volume.grid.affine, at((4, 5, 6)))
    old = nibabel.AnalyzeImage(VALUES, None)
    old.header["vox_units"] = b"cm"
    nibabel.save(old, tmp_path / "old.img")
    assert read(tmp_path / "old.img")[0].grid.spacing.tolist() == [10, 10, 10]
    old.header["vox_units"] = b"in"
    nibabel.save(old, tmp_path / "old.img")
    with pytest.raises(mph.InputError, match="vox_units 'in'"):
        read(tmp_path / "old.img")


def test_an_hdf5_affine_of_another_unit_is_refused(tmp_path):
    h5py = pytest.importorskip("h5py")
    for unit in ("mm", "cm"):
        with h5py.File(tmp_path / f"{unit}.h5", "w") as file:
            file["array"] = VALUES
            file.create_dataset("affine", data=np.eye(4)).attrs["unit"] = unit
    assert read(tmp_path / "mm.h5")[1] == []
    with pytest.raises(mph.InputError, match="its affine is in cm: expected mm"):
        read(tmp_path / "cm.h5")
