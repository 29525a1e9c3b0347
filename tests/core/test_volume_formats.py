"""Volumes in every format: round trips, positions in DICOM and ITK, and one clear line for files that are no volumes."""

from __future__ import annotations

import errno
import io
import logging
import os
import shutil
import zlib
from pathlib import Path

import h5py
import nibabel
import nrrd
import numpy as np
import pytest
from pydicom.dataset import Dataset
from pydicom.encaps import encapsulate
from pydicom.uid import EnhancedCTImageStorage, JPEG2000Lossless, JPEGLSLossless, RLELossless

import mphdrr.core as mph
from mphdrr.core.geometry.frames import euler_pose

from .conftest import general_grid
from .dicom_files import LPS, numbers, save, set_tags, write_series, write_tomogram

CHEST = Path(__file__).parents[3] / "shared" / "data" / "chest_ct_3mm.nii.gz"


def turned_grid(shape=(5, 6, 7)) -> mph.Grid:
    """Return an oblique grid, with right angles and iz towards the head, that a series can express."""
    affine = euler_pose(0.3, 0.2, -0.1, (10, -20, 30))
    affine[:3, :3] @= np.diag([0.7, 0.9, 2.5])
    return mph.Grid(shape, affine)


@pytest.fixture
def ct(rng) -> mph.Volume:
    grid = turned_grid()
    return mph.Volume(rng.integers(-1000, 2000, grid.shape), grid, "hu")


@pytest.mark.parametrize("name", ["v.npz", "v.nrrd", "v.h5", "v.HDF5", "v.nii", "v.nii.gz", "V.NII.GZ"])
def test_every_format_gives_back_all_of_a_volume(tmp_path, rng, name):
    grid = general_grid(rng, (5, 6, 7))
    volume = mph.Volume(rng.normal(size=grid.shape), grid, "mu")
    mph.write_volume(volume, tmp_path / name)
    back = mph.read_volume(tmp_path / name)
    assert np.array_equal(back.array, volume.array)
    # NIfTI keeps its affine in float32.
    assert np.allclose(back.grid.affine, grid.affine, rtol=0, atol=1e-5 if ".nii" in name.lower() else 0)
    assert back.quantity == "mu"
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["v.npz", "v.nrrd", "v.h5", "v.nii"])
def test_a_files_note_says_what_the_volumes_does(tmp_path, name):
    volume = mph.Volume(np.ones((3, 4, 5)), mph.Grid.centered((3, 4, 5), 1.0), note="Reconstructed by a network")
    mph.write_volume(volume, tmp_path / name)
    assert np.array_equal(mph.read_volume(tmp_path / name).array, volume.array)
    if name == "v.npz":
        note = str(np.load(tmp_path / name)["note"])
    elif name == "v.nrrd":
        note = nrrd.read_header(str(tmp_path / name))["note"]
    elif name == "v.h5":
        with h5py.File(tmp_path / name) as file:
            note = file["array"].attrs["note"]
    else:
        note = nibabel.load(tmp_path / name).header.extensions[0].text
    assert note == volume.note


def test_a_runs_volume_is_read_from_its_file(tmp_path, system, ct):
    run = mph.project_run(system[:1], mph.hu_to_mu(ct), shape=(4, 4), backend="numpy")
    mph.write_run(run, tmp_path / "run.h5")
    back = mph.read_volume(tmp_path / "run.h5")
    assert np.array_equal(back.array, run.volume.array)
    assert (back.grid, back.quantity) == (run.volume.grid, "mu")


@pytest.mark.parametrize("kind", ["<i2", ">i2", "<f4", "u1"])
def test_analyze_and_npy(tmp_path, rng, kind):
    array = rng.integers(0, 200, (4, 5, 6)).astype(kind)
    nibabel.save(nibabel.Nifti1Pair(array, turned_grid().affine), tmp_path / "pair.img")
    assert np.array_equal(mph.read_volume(tmp_path / "pair.hdr").array, array)
    with pytest.warns(mph.InputWarning, match="do not say where the patient lies"):
        nibabel.save(nibabel.AnalyzeImage(array.astype("i2"), None), tmp_path / "old.img")
        assert np.array_equal(mph.read_volume(tmp_path / "old.img").array, array)
    np.save(tmp_path / "a.npy", array)
    volume = mph.read_volume(tmp_path / "a.npy", "mu", affine=turned_grid().affine)
    assert np.array_equal(volume.array, array)
    assert np.array_equal(volume.grid.affine, turned_grid().affine)


def write_meta_image(path: Path, array: np.ndarray, data: bytes | None = None, **changes: str) -> None:
    header = {
        "ObjectType": "Image",
        "NDims": "3",
        "BinaryData": "True",
        "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False",
        "TransformMatrix": "0 1 0 -1 0 0 0 0 1",  # axis 0 along y, axis 1 along -x
        "Offset": "10 20 30",
        "ElementSpacing": "0.5 2 3",
        "DimSize": " ".join(map(str, array.shape)),
        "ElementType": "MET_SHORT",
        "ElementDataFile": "LOCAL",
        **changes,
    }
    header["ElementDataFile"] = header.pop("ElementDataFile")  # the last line
    text = "".join(f"{key} = {value}\n" for key, value in header.items() if value)
    path.write_bytes(text.encode() + (array.tobytes(order="F") if data is None else data))


def test_meta_image_lies_where_itk_puts_it(tmp_path, rng):
    array = rng.integers(-1000, 2000, (3, 4, 5)).astype("<i2")
    path = tmp_path / "v.mha"
    write_meta_image(path, array)
    volume = mph.read_volume(path)
    assert np.array_equal(volume.array, array)
    expected = LPS @ [[0, -2, 0, 10], [0.5, 0, 0, 20], [0, 0, 3, 30], [0, 0, 0, 1]]
    assert np.allclose(volume.grid.affine, expected)
    write_meta_image(path, array, CompressedData="True", data=zlib.compress(array.tobytes(order="F")))
    assert np.array_equal(mph.read_volume(path).array, array)
    raw = array.astype(">i2").tobytes(order="F")
    (tmp_path / "v.raw").write_bytes(b"12345" + raw)
    for skip in ("5", "-1"):
        changes = {"BinaryDataByteOrderMSB": "True", "HeaderSize": skip, "ElementDataFile": "v.raw"}
        write_meta_image(tmp_path / "v.mhd", array, data=b"", **changes)
        assert np.array_equal(mph.read_volume(tmp_path / "v.mhd").array, array)


@pytest.mark.parametrize("name", ["v.mha", "v.mhd", "v.nrrd", "v.nii.gz", "series"])
def test_simpleitk_puts_every_voxel_in_the_same_place(tmp_path, ct, name):
    itk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed")
    image = itk.GetImageFromArray(ct.array.transpose(2, 1, 0))
    lps = LPS @ ct.grid.affine
    image.SetSpacing(ct.grid.spacing.tolist())
    image.SetDirection((lps[:3, :3] / ct.grid.spacing).ravel().tolist())
    image.SetOrigin(lps[:3, 3].tolist())
    if name == "series":
        write_series(ct, tmp_path / name)
        reader = itk.ImageSeriesReader()
        reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(tmp_path / name)))
        back = reader.Execute()
        assert np.allclose(*(series.TransformIndexToPhysicalPoint((1, 2, 3)) for series in (back, image)))
        assert np.array_equal(itk.GetArrayFromImage(back), itk.GetArrayFromImage(image))
    else:
        itk.WriteImage(image, str(tmp_path / name), useCompression=name == "v.mha")
    volume = mph.read_volume(tmp_path / name)
    assert np.array_equal(volume.array, ct.array)
    assert np.allclose(volume.grid.affine, ct.grid.affine, rtol=0, atol=1e-5)
    for suffix in (".nrrd", ".nii"):
        mph.write_volume(ct, tmp_path / f"ours{suffix}")
        theirs = itk.ReadImage(str(tmp_path / f"ours{suffix}"))
        assert np.allclose(theirs.TransformIndexToPhysicalPoint((4, 0, 6)), (lps @ [4, 0, 6, 1])[:3], atol=1e-4)
        assert np.array_equal(itk.GetArrayFromImage(theirs), ct.array.transpose(2, 1, 0))


@pytest.mark.parametrize("order", [range(7), range(6, -1, -1)], ids=["up", "down"])
def test_simpleitk_puts_tomograms_in_the_same_place(tmp_path, ct, order):
    itk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed")
    counts = mph.Volume(2 * np.abs(ct.array) + 1, ct.grid)
    write_tomogram(counts, tmp_path / "recon.dcm", order)
    image = itk.ReadImage(str(tmp_path / "recon.dcm"))
    volume = mph.read_volume(tmp_path / "recon.dcm", "activity")
    for index in ((0, 0, 0), (4, 1, 6), (2, 5, 3)):
        place = (LPS @ volume.grid.affine @ [*index, 1])[:3]
        assert image[image.TransformPhysicalPointToIndex(place.tolist())] == volume.array[index]


@pytest.mark.parametrize("space", ["right-anterior-superior", "left-anterior-superior", "LPS", None])
def test_nrrd_spaces(tmp_path, rng, space):
    array = rng.integers(0, 100, (3, 4, 5)).astype(np.int16)
    header = {"space directions": np.diag([1.0, 2, 3]), "space origin": [10.0, 20, 30]}
    header |= {"space": space} if space else {"space dimension": 3}
    nrrd.write(str(tmp_path / "v.nhdr"), array, header, detached_header=True)
    volume = mph.read_volume(tmp_path / "v.nhdr")
    signs = {"left-anterior-superior": (-1, 1, 1), "LPS": (-1, -1, 1)}.get(space, (1, 1, 1))
    expected = np.diag([*signs, 1]) @ [[1, 0, 0, 10], [0, 2, 0, 20], [0, 0, 3, 30], [0, 0, 0, 1]]
    assert np.array_equal(volume.grid.affine, expected)
    assert np.array_equal(volume.array, array)


def test_a_series_in_any_order_is_the_volume_it_was_written_from(tmp_path, ct, rng):
    names = [f"IM{n:03d}" for n in rng.permutation(7)]  # no suffix, and names in no order
    write_series(ct, tmp_path / "series", names=names)
    (tmp_path / "series" / "readme.txt").write_text("not an image")
    seen = []
    volume = mph.read_volume(tmp_path / "series", progress=lambda done, total: seen.append((done, total)))
    assert np.array_equal(volume.array, ct.array)
    assert np.allclose(volume.grid.affine, ct.grid.affine, rtol=0, atol=1e-9)
    assert volume.quantity == "hu"
    assert seen == [(k, 7) for k in range(1, 8)]
    assert mph.read_volume(tmp_path / "series" / names[3]).grid == volume.grid

    def stop(done: int, total: int) -> None:
        raise mph.Cancelled

    with pytest.raises(mph.Cancelled):
        mph.read_volume(tmp_path / "series", progress=stop)


def test_the_chest_is_the_same_from_nifti_and_from_dicom(tmp_path):
    if not CHEST.is_file():
        pytest.skip(f"no {CHEST.name} beside the checkout")
    nifti = mph.read_volume(CHEST)
    write_series(nifti, tmp_path / "series")
    series = mph.read_volume(tmp_path / "series")
    assert np.array_equal(series.array, nifti.array)
    assert np.allclose(series.grid.affine, nifti.grid.affine, rtol=0, atol=1e-9)


def test_every_other_slice_missing_is_warned_of(tmp_path, ct):
    for data in write_series(ct, tmp_path / "s")[1::2]:
        Path(data.filename).unlink()
    with pytest.warns(mph.InputWarning, match=r"the slices are 2\.5 mm thick and lie 5 mm apart"):
        volume = mph.read_volume(tmp_path / "s")
    assert np.array_equal(volume.array, ct.array[:, :, ::2])


def test_a_series_in_jpeg_2000_is_the_same_volume(tmp_path, rng):
    ct = mph.Volume(rng.integers(-1000, 3000, (40, 36, 3)).astype(np.float32), turned_grid((40, 36, 3)), quantity="hu")
    for data in write_series(ct, tmp_path / "series"):
        data.compress(JPEG2000Lossless)
        save(data)
    assert np.array_equal(mph.read_volume(tmp_path / "series").array, ct.array)


def test_one_of_several_series_is_chosen(tmp_path, ct):
    write_series(ct, tmp_path / "s", 3, "Soft")
    other = mph.Volume(ct.array + 1, ct.grid, "hu")
    written = write_series(other, tmp_path / "s", 4, "Bone")
    with pytest.raises(mph.InputError, match=r'2 series, choose one: 3 "Soft" \(7 images\); 4 "Bone" \(7 images\)'):
        mph.read_volume(tmp_path / "s")
    for name in ("4", "Bone", written[0].SeriesInstanceUID):
        assert np.array_equal(mph.read_volume(tmp_path / "s", series=name).array, other.array)
    assert np.array_equal(mph.read_volume(written[2].filename).array, other.array)
    with pytest.raises(mph.InputError, match="no series '5'"):
        mph.read_volume(tmp_path / "s", series="5")


def test_enhanced_and_run_length_coded_images(tmp_path, ct):
    written = write_series(ct, tmp_path / "s")
    for data in written:
        data.compress(RLELossless)
        save(data)
    assert np.array_equal(mph.read_volume(tmp_path / "s").array, ct.array)

    def sequence_of(**tags):
        return [set_tags(Dataset(), **tags)]

    image = write_series(ct, tmp_path / "e")[0]
    order = [3, 0, 6, 1, 5, 2, 4]
    positions = (LPS @ ct.grid.affine @ [[0] * 7, [0] * 7, order, [1] * 7])[:3].T
    positions = [sequence_of(ImagePositionPatient=numbers(position)) for position in positions]
    shared = sequence_of(
        PixelMeasuresSequence=sequence_of(PixelSpacing=image.PixelSpacing, SliceThickness="2.5"),
        PlaneOrientationSequence=sequence_of(ImageOrientationPatient=image.ImageOrientationPatient),
        PixelValueTransformationSequence=sequence_of(RescaleSlope="1", RescaleIntercept="-1000", RescaleType="HU"),
    )
    moved = ("PixelSpacing", "ImageOrientationPatient", "ImagePositionPatient", "RescaleSlope", "RescaleIntercept")
    image.SOPClassUID = image.file_meta.MediaStorageSOPClassUID = EnhancedCTImageStorage
    set_tags(
        image, **dict.fromkeys(moved), NumberOfFrames=7, SharedFunctionalGroupsSequence=shared,
        PerFrameFunctionalGroupsSequence=[sequence_of(PlanePositionSequence=position)[0] for position in positions],
        PixelData=(ct.array[:, :, order].transpose(2, 1, 0) + 1000).astype("<u2").tobytes(),
    )  # fmt: skip
    shutil.rmtree(tmp_path / "e")
    (tmp_path / "e").mkdir()
    save(image)
    volume = mph.read_volume(tmp_path / "e")
    assert np.array_equal(volume.array, ct.array)
    assert np.allclose(volume.grid.affine, ct.grid.affine, rtol=0, atol=1e-9)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("order", [range(7), range(6, -1, -1), (2, 0, 5, 1, 4, 6, 3)], ids=["up", "down", "any"])
def test_a_reconstructed_tomogram_is_the_volume_it_was_written_from(tmp_path, rng, mirrored, order):
    """By the first frame's position and the signed spacing; if mirrored, slices follow each other against their normal."""
    grid = turned_grid()
    if mirrored:
        grid = mph.Grid(grid.shape, grid.affine @ np.diag([-1, 1, 1, 1]))
    volume = mph.Volume(2 * rng.integers(0, 30000, grid.shape) + 1, grid, "activity")
    data = write_tomogram(volume, tmp_path / "recon.dcm", order)
    with pytest.raises(mph.InputError, match="it holds 'NM': say which quantity that is"):
        mph.read_volume(tmp_path)
    for path in (tmp_path, tmp_path / "recon.dcm"):
        back = mph.read_volume(path, "activity")
        assert np.array_equal(back.array, volume.array)
        assert np.allclose(back.grid.affine, grid.affine, rtol=0, atol=1e-9)
    # Some programs write the position outside the detectors; values in Bq/mL are marked so.
    (detector,) = data.DetectorInformationSequence
    place = {name: getattr(detector, name) for name in ("ImagePositionPatient", "ImageOrientationPatient")}
    unit, mapping = Dataset(), Dataset()
    unit.CodeValue, unit.CodingSchemeDesignator, unit.CodeMeaning = "Bq/ml", "UCUM", "Becquerels/milliliter"
    mapping.MeasurementUnitsCodeSequence, mapping.RealWorldValueSlope = [unit], 4000.0
    mapping.RealWorldValueIntercept = 2000.0
    more = {"DetectorInformationSequence": None, "RealWorldValueMappingSequence": [mapping]}
    write_tomogram(volume, tmp_path / "recon.dcm", order, **place, **more)
    back = mph.read_volume(tmp_path / "recon.dcm")
    assert (back.quantity, back.grid.shape) == ("activity", grid.shape)
    assert np.allclose(back.array, 2 * volume.array)
    assert np.allclose(back.grid.affine, grid.affine, rtol=0, atol=1e-9)


def test_one_of_several_tomograms_of_a_series_is_chosen_by_its_file(tmp_path, ct):
    counts = mph.Volume(np.abs(ct.array) * 2 + 1, ct.grid)
    one = write_tomogram(counts, tmp_path / "a.dcm", SeriesInstanceUID="1.2")
    write_tomogram(counts, tmp_path / "b.dcm", SeriesInstanceUID="1.2", ImageType=["ORIGINAL", "PRIMARY", "TOMO"])
    with pytest.raises(mph.InputError, match=r"several files of several frames each, choose one: a\.dcm, b\.dcm"):
        mph.read_volume(tmp_path)
    assert np.array_equal(mph.read_volume(one.filename, "activity").array, counts.array)
    del one.SpacingBetweenSlices
    save(one)
    with pytest.warns(mph.InputWarning, match="it has no SpacingBetweenSlices"):
        back = mph.read_volume(one.filename, "activity")
    assert np.allclose(back.grid.affine, ct.grid.affine, rtol=0, atol=1e-9)


def bad_file(name):
    """Decorate a function that writes bad input to a path, given a CT: with its settings it makes a case of that name."""

    def decorate(write):
        def with_settings(*settings, **more):
            def make(folder, ct):
                write(folder / name, ct, *settings, **more)
                return folder / name

            return make

        return with_settings

    return decorate


@bad_file("series")
def _series(folder, ct, change):
    change(write_series(ct, folder), folder)


@bad_file("series")
def _set(folder, ct, k, **tags):
    save(set_tags(write_series(ct, folder)[k], **tags))


@bad_file("series")
def _cut(folder, ct, k, size):
    path = Path(write_series(ct, folder)[k].filename)
    path.write_bytes(path.read_bytes()[:size])


@bad_file("series")
def _several(folder, ct):
    write_series(ct, folder, 1)
    write_series(ct, folder, 2)


def _text_for_a_number(written, folder):
    path = Path(written[4].filename)
    head, tag, rest = path.read_bytes().partition(b"(\x00R\x10DS")  # RescaleIntercept
    path.write_bytes(head + tag + rest[:2] + b"nothing!"[: rest[0]] + rest[2 + rest[0] :])


def _compressed(written, folder):
    for data in written:
        data.file_meta.TransferSyntaxUID = JPEGLSLossless
        data.PixelData = encapsulate([b"\xff\xd8 not a picture \xff\xd9"])
        data["PixelData"].is_undefined_length = True
        save(data)


@bad_file("v.nii")
def _nifti(path, ct, array, code=None):
    nibabel.save(nibabel.Nifti1Image(array, np.eye(4)), path)
    if code is not None:
        data = bytearray(path.read_bytes())
        data[70:72] = code.to_bytes(2, "little")
        path.write_bytes(data)


@bad_file("v.mha")
def _meta(path, ct, **changes):
    write_meta_image(path, ct.array.astype("<i2"), **changes)


@bad_file("v.npz")
def _npz(path, ct, **changes):
    np.savez(path, **{"array": ct.array, "affine": ct.grid.affine, "quantity": "mu", "unit": "1/mm", **changes})


@bad_file("v.nrrd")
def _nrrd(path, ct, shape=(3, 4, 5), **header):
    nrrd.write(str(path), np.zeros(shape, np.float32), header)


@bad_file("v.h5")
def _hdf5(path, ct, **datasets):
    with h5py.File(path, "w") as file:
        for name, value in datasets.items():
            file[name] = value


@bad_file("nm.dcm")
def _tomogram(path, ct, **changes):
    write_tomogram(mph.Volume(np.abs(ct.array), ct.grid), path, **changes)


@bad_file("v.nii")
def _pipe(path, ct):
    if not hasattr(os, "mkfifo"):
        pytest.skip("no pipes on this system")
    os.mkfifo(path)


def _bytes(name, data):
    return bad_file(name)(lambda path, ct: path.write_bytes(data))()


def _truncated(name):
    def write(path, ct):
        mph.write_volume(ct, path)
        data = path.read_bytes()
        path.write_bytes(data[: len(data) * 2 // 3])

    return bad_file(name)(write)()


NAN = np.zeros((3, 3, 3), np.float32)
NAN[1, 2, 0] = np.nan

BAD = {
    "two slices missing": (
        _series(lambda written, folder: [Path(data.filename).unlink() for data in written[2:4]]),
        "2 slices missing between 1-0001.dcm and 1-0004.dcm: 7.5 mm apart",
    ),
    "a slice twice": (
        _series(lambda written, folder: shutil.copy(written[2].filename, folder / "again.dcm")),
        "lie at the same place",
    ),
    "mixed sizes": (_set(3, Rows=5, PixelData=b"0" * 50), "1-0003.dcm has 5 x 5 pixels, unlike 1-0000.dcm"),
    "mixed pixels": (_set(3, PixelSpacing=[1, 1]), "1-0003.dcm has pixels of 1 x 1 mm"),
    "mixed orientations": (_set(5, ImageOrientationPatient=[1, 0, 0, 0, 1, 0]), "1-0005.dcm has another orientation"),
    "no right angle": (_set(0, ImageOrientationPatient=[1, 0, 0, 1, 0, 0]), "two unit vectors at right angles"),
    "several series": (_several(), "it holds 2 series, choose one"),
    "no position": (_set(2, ImagePositionPatient=None), "1-0002.dcm: it has no ImagePositionPatient"),
    "colour": (_set(1, SamplesPerPixel=3, PhotometricInterpretation="RGB"), "1-0001.dcm: expected one value per pixel"),
    "frames without places": (_set(0, NumberOfFrames=2), "2 frames without a place for each"),
    "last slice cut in its header": (_cut(-1, 600), "an image without Rows"),
    "last slice cut in its first tags": (_cut(-1, 170), "an image without Rows"),
    "text for a number": (_series(_text_for_a_number), "1-0004.dcm: cannot be read as DICOM (could not convert"),
    "no columns": (_set(3, Columns=None), "1-0003.dcm: cannot be read as DICOM"),
    "truncated slice": (_cut(4, -20), "1-0004.dcm"),
    "compressed slices": (_series(_compressed), "its pixels are compressed (JPEG-LS"),
    "magnetic resonance": (
        _series(lambda written, folder: [save(set_tags(d, Modality="MR", RescaleType=None)) for d in written]),
        "it holds 'MR': say which quantity that is",
    ),
    "SPECT projections": (
        _tomogram(ImageType=["ORIGINAL", "PRIMARY", "TOMO", "EMISSION"], SliceVector=None),
        "nm.dcm: it holds projections (ImageType TOMO, 7 frames); expected a reconstructed tomogram",
    ),
    "planar images": (_tomogram(ImageType=["ORIGINAL", "PRIMARY", "STATIC"]), "planar images (ImageType STATIC"),
    "a gated tomogram": (
        _tomogram(
            ImageType=["DERIVED", "PRIMARY", "RECON GATED TOMO", "EMISSION"],
            TimeSlotVector=[1, 1, 1, 1, 2, 2, 2],
            NumberOfTimeSlots=2,
            SliceVector=[1, 2, 3, 4, 1, 2, 3],
        ),
        "the tomogram is gated, in 2 time slots (7 frames); expected one volume",
    ),
    "a gated tomogram without vectors": (
        _tomogram(NumberOfTimeSlots=7, NumberOfSlices=1, SliceVector=None),
        "the tomogram is gated, in 7 time slots (7 frames)",
    ),
    "energy windows": (_tomogram(EnergyWindowVector=[1, 1, 1, 1, 2, 2, 2]), "the tomogram is of 2 energy windows"),
    "more frames": (_tomogram(NumberOfSlices=6, NumberOfEnergyWindows=1, SliceVector=None), "7 frames of 6"),
    "slices twice": (
        _tomogram(SliceVector=[1, 2, 3, 3, 2, 1, 4], NumberOfEnergyWindows=1),
        "7 frames of 4 slices; expected one frame of each",
    ),
    "a slice missing in the middle": (_tomogram(SliceVector=[1, 2, 3, 5, 6, 7, 8]), "1 slice missing between"),
    "too few slice numbers": (_tomogram(SliceVector=[1, 2, 3]), "SliceVector: expected 7 numbers, got [1, 2, 3]"),
    "a tomogram nowhere": (_tomogram(DetectorInformationSequence=None), "nm.dcm: it has no ImagePositionPatient"),
    "slices at one place": (_tomogram(SpacingBetweenSlices=0), "lie at the same place"),
    "an empty folder": (
        bad_file("empty")(lambda path, ct: path.mkdir())(),
        "expected a folder with images of a DICOM series",
    ),
    "a pipe": (_pipe(), "neither a file nor a folder"),
    "an empty file": (_bytes("v.nrrd", b""), "it is empty"),
    "a name that cannot be": (lambda folder, ct: folder / ("v" * 300 + ".nii"), "ame too long"),
    "an empty NIfTI": (_bytes("v.nii", b""), "v.nii"),
    "an empty archive": (_bytes("v.npz", b""), "v.npz"),
    "no archive": (_bytes("v.npz", b"hello " * 100), "v.npz"),
    "no numpy file": (_bytes("v.npy", b"hello" * 99), "not a file of numpy"),
    "NRRD cut in its header": (_bytes("v.nrrd", b"NRRD0004\ntype: short\n"), "it has no field sizes"),
    "half a voxel": (_meta(DimSize="5 6 6.5"), "DimSize = 6.5: expected a whole number from 1"),
    "no DICOM": (_bytes("v.dcm", b"hello" * 99), "v.dcm is no DICOM file"),
    "unknown suffix": (_bytes("v.xyz", b"hello" * 99), "expected a folder of DICOM files, or a name ending in"),
    "4-D NIfTI": (_nifti(np.zeros((3, 3, 3, 2), np.float32)), "expected a 3-D image, got shape 3 x 3 x 3 x 2"),
    "NaN": (_nifti(NAN), "nan is not a finite number at index (1, 2, 0)"),
    "complex NIfTI": (_nifti(np.zeros((3, 3, 3), np.complex64)), "expected real numbers"),
    "NIfTI of colours": (_nifti(np.zeros((3, 3, 3), [(c, "u1") for c in "RGB"])), "expected real numbers"),
    "no NIfTI": (_bytes("v.nii", b"hello" * 99), "not a NIfTI file"),
    "no gzip": (_bytes("v.nii.gz", b"hello" * 99), "not a NIfTI file"),
    "NIfTI of no type": (_nifti(np.zeros((3, 3, 3), np.float32), 2164), "data code 2164 not recognized"),
    "truncated NIfTI": (_truncated("v.nii"), "cannot be read as .nii"),
    "truncated gzip": (_truncated("v.nii.gz"), "not a NIfTI file"),
    "truncated npz": (_truncated("v.npz"), "cannot be read as .npz"),
    "truncated NRRD": (_truncated("v.nrrd"), "its data are damaged or end early; expected 5 x 6 x 7 voxels"),
    "truncated HDF5": (_truncated("v.h5"), "cut: "),
    "4-D NRRD": (_nrrd((3, 4, 5, 2)), "expected a 3-D image, got shape 3 x 4 x 5 x 2"),
    "unknown space": (
        _nrrd(space="scanner-xyz", **{"space directions": np.eye(3)}),
        "space 'scanner-xyz': expected right-anterior-superior",
    ),
    "wrong unit": (_npz(unit="1/cm"), "its values are in 1/cm; expected 1/mm for mu"),
    "unknown quantity": (_npz(quantity="warmth", unit="Gy"), "it holds 'warmth': say which quantity that is"),
    "a singular affine": (_npz(affine=np.diag([1, 1, 0, 1])), "its three axes are not independent"),
    "an affine of 3 rows": (_npz(affine=np.eye(4)[:3]), "expected shape 4 x 4, got 3 x 4"),
    "no affine": (bad_file("v.npy")(lambda path, ct: np.save(path, ct.array))(), "it has no affine: give one"),
    "HDF5 without the array": (_hdf5(data=np.zeros((3, 3, 3))), "array not found (there are: data)"),
    "text in HDF5": (_hdf5(array="abc", affine=np.eye(4)), "expected a 3-D image"),
    "MetaImage too short": (_meta(DimSize="5 6 8"), "expected 480 bytes of voxels"),
    "MetaImage too long": (_meta(DimSize="5 6 6"), "360 bytes of voxels (DimSize x ElementType), it holds more"),
    "MetaImage of colours": (_meta(ElementNumberOfChannels="3"), "expected one value per voxel, found 3"),
    "MetaImage of another type": (_meta(ElementType="MET_OTHER"), "ElementType MET_OTHER: expected one of"),
    "no voxels of a MetaImage": (_meta(ElementDataFile="gone.raw"), "gone.raw: its numbers are read from the header"),
    "MetaImage of text": (_meta(ElementSpacing="1 a 3"), "ElementSpacing = 1 a 3: expected numbers"),
    "2-D MetaImage": (_meta(DimSize="5 6", NDims="2"), "expected a 3-D image, got shape 5 x 6"),
    "MetaImage of nothing": (_bytes("v.mha", b"\x00" * 99), "not a MetaImage file"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gets_one_line_that_names_the_place(tmp_path, ct, case, monkeypatch):
    make, expected = BAD[case]
    path, logged = make(tmp_path, ct), []
    monkeypatch.setattr(logging.Logger, "handle", lambda logger, record: logged.append(f"{logger.name} {record}"))
    with pytest.raises(mph.InputError) as error:
        mph.read_volume(path)
    message = str(error.value)
    assert expected in message
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert not [record for record in logged if "nibabel" in record]  # which would be printed on standard error


@pytest.mark.parametrize("of_series", [False, True])
def test_what_may_not_be_read_is_said_and_not_left_out(tmp_path, ct, monkeypatch, of_series):
    write_series(ct, tmp_path / "s", names=[f"slice{k}" for k in range(7)])
    mph.write_volume(ct, tmp_path / "v.nii")
    locked = tmp_path / "s/slice6" if of_series else tmp_path / "v.nii"  # a missing last slice leaves no gap
    may_open = io.open

    def open_others(path, *args, **kwargs):
        if path == locked:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return may_open(path, *args, **kwargs)

    monkeypatch.setattr("builtins.open", open_others)
    monkeypatch.setattr("io.open", open_others)
    with pytest.raises(mph.InputError, match=f"{locked.name}.*Permission denied"):
        mph.read_volume(tmp_path / "s" if of_series else locked)


def test_series_and_affines_are_checked_too(tmp_path, ct):
    mph.write_volume(ct, tmp_path / "v.nii")
    with pytest.raises(mph.InputError, match="only folders of DICOM files hold several series"):
        mph.read_volume(tmp_path / "v.nii", series="1")
    with pytest.raises(mph.InputError, match="affine: expected shape 4 x 4"):
        mph.read_volume(tmp_path / "v.nii", affine=np.eye(3))
