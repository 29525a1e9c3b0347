"""Writes a volume of CT numbers as a DICOM series, and one of counts as a reconstructed tomogram, by pydicom."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, NuclearMedicineImageStorage, generate_uid

import mphdrr.core as mph

LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


def new_dataset(kind: str, **tags) -> Dataset:
    """Return a data set of 16-bit grey pixels with a class of DICOM objects and `tags`."""
    data = Dataset()
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = kind
    data.SOPInstanceUID = data.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 0
    return set_tags(data, **tags)


def set_tags(data: Dataset, **tags) -> Dataset:
    """Set tags of a data set; None removes one."""
    for name, value in tags.items():
        if value is None:
            delattr(data, name)
        else:
            setattr(data, name, value)
    return data


def write_series(
    volume: mph.Volume, folder: Path, number: int = 1, description: str = "Thorax", names=None
) -> list[Dataset]:
    """Write a file for each plane of iz, with its own slope and intercept; return the data sets, which know their files."""
    folder.mkdir(exist_ok=True)
    affine, spacing = LPS @ volume.grid.affine, volume.grid.spacing
    series, study, frame = generate_uid(), generate_uid(), generate_uid()
    names = names if names is not None else [f"{number}-{k:04d}.dcm" for k in range(volume.grid.shape[2])]
    written = []
    for k, name in enumerate(names):
        slope, intercept = (1.0, -1024.0) if k % 2 else (0.5, -1000.0)
        stored = np.rint((volume.array[:, :, k].T - intercept) / slope).astype("<u2")
        data = new_dataset(
            CTImageStorage, Modality="CT", SeriesNumber=number, SeriesDescription=description, InstanceNumber=k + 1,
            SeriesInstanceUID=series, StudyInstanceUID=study, FrameOfReferenceUID=frame,
            Rows=volume.grid.shape[1], Columns=volume.grid.shape[0],
            PixelSpacing=numbers(spacing[1::-1]), SliceThickness=number_text(spacing[2]),
            ImageOrientationPatient=numbers((affine[:3, :2] / spacing[:2]).T.ravel()),
            ImagePositionPatient=numbers((affine @ [0, 0, k, 1])[:3]),
            RescaleSlope=slope, RescaleIntercept=intercept, RescaleType="HU", PixelData=stored.tobytes(),
        )  # fmt: skip
        data.filename = str(folder / name)
        save(data)
        written.append(data)
    return written


def write_tomogram(volume: mph.Volume, path: Path, order=None, **changes) -> Dataset:
    """Write a nuclear medicine file whose frame i is the plane `order[i]` of iz; `changes` are tags, None removes one.

    By default the planes follow each other from first to last. SliceVector numbers them in the direction in which the last
    frame lies from the first.
    """
    n_x, n_y, n_z = volume.grid.shape
    order = np.arange(n_z) if order is None else np.asarray(order)
    affine, spacing = LPS @ volume.grid.affine, volume.grid.spacing
    axes = affine[:3, :3] / spacing
    along = np.sign(np.cross(axes[:, 0], axes[:, 1]) @ axes[:, 2])
    way = 1 if order[-1] >= order[0] else -1
    detector = Dataset()
    detector.ImageOrientationPatient = numbers(axes[:, :2].T.ravel())
    detector.ImagePositionPatient = numbers((affine @ [0, 0, order[0], 1])[:3])
    stored = np.rint((volume.array[:, :, order].transpose(2, 1, 0) - 1) / 2).astype("<u2")
    tags = {
        "ImageType": ["DERIVED", "PRIMARY", "RECON TOMO", "EMISSION"],
        "NumberOfFrames": len(order), "NumberOfSlices": n_z, "NumberOfEnergyWindows": 2,  # one window for scatter
        "FrameIncrementPointer": 0x00540080, "SliceVector": [int(k if way > 0 else n_z - 1 - k) + 1 for k in order],
        "DetectorInformationSequence": [detector], "SpacingBetweenSlices": number_text(along * way * spacing[2]),
        "SliceThickness": number_text(spacing[2]), "PixelSpacing": numbers(spacing[1::-1]),
        "Rows": n_y, "Columns": n_x, "RescaleSlope": 2, "RescaleIntercept": 1, "PixelData": stored.tobytes(),
    }  # fmt: skip
    return write_nuclear(path, tags, changes)


def write_nuclear(path: Path, tags: dict, changes: dict) -> Dataset:
    """Write a nuclear medicine file of these tags, some of them changed, None removes one."""
    data = new_dataset(NuclearMedicineImageStorage, SeriesInstanceUID=generate_uid(), Modality="NM", **tags)
    set_tags(data, **changes)
    data.filename = str(path)
    save(data)
    return data


def number_text(value: float) -> str:
    """Return a number in the 16 characters of a decimal string."""
    return next(text for digits in range(16, 0, -1) if len(text := f"{value:.{digits}g}") <= 16)


def numbers(values: np.ndarray) -> list[str]:
    """Return numbers as decimal strings."""
    return [number_text(value) for value in values]


def save(data: Dataset) -> None:
    data.save_as(data.filename, enforce_file_format=True)


def write_frames(frames: np.ndarray, path: Path, milliseconds: int | None = None, **changes) -> Dataset:
    """Write a nuclear medicine file of planar frames (n, rows, columns) of counts; `changes` are tags, None removes one."""
    n, rows, columns = frames.shape
    tags = {
        "ImageType": ["ORIGINAL", "PRIMARY", "STATIC", "EMISSION"], "FrameIncrementPointer": 0x00540020,
        "NumberOfFrames": n, "Rows": rows, "Columns": columns, "NumberOfDetectors": n,
        "DetectorVector": list(range(1, n + 1)), "PixelData": frames.astype("<u2").tobytes(),
    }  # fmt: skip
    return write_nuclear(path, tags | ({} if milliseconds is None else {"ActualFrameDuration": milliseconds}), changes)


def real_world_values(slope: float, intercept: float, unit: str) -> Dataset:
    """Return an item of RealWorldValueMappingSequence to a unit of UCUM."""
    code = set_tags(Dataset(), CodeValue=unit, CodingSchemeDesignator="UCUM", CodeMeaning=unit)
    return set_tags(
        Dataset(), RealWorldValueFirstValueMapped=0, RealWorldValueLastValueMapped=65535, LUTLabel="A",
        RealWorldValueSlope=slope, RealWorldValueIntercept=intercept, MeasurementUnitsCodeSequence=[code],
    )  # fmt: skip
