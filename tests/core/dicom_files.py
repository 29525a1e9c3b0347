"""Writes a volume of CT numbers as a DICOM series, and one of counts as a reconstructed tomogram, by pydicom."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, NuclearMedicineImageStorage, generate_uid

import mphdrr.core as mph

LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


def write_series(
    volume: mph.Volume, folder: Path, number: int = 1, description: str = "Thorax", names=None
) -> list[Dataset]:
    """Write a file for each plane of iz, with its own slope and intercept; return the data sets, which know their files."""
    folder.mkdir(exist_ok=True)
    affine = LPS @ volume.grid.affine
    spacing = volume.grid.spacing
    series, study, frame = generate_uid(), generate_uid(), generate_uid()
    names = names if names is not None else [f"{number}-{k:04d}.dcm" for k in range(volume.grid.shape[2])]
    written = []
    for k, name in enumerate(names):
        slope, intercept = (1.0, -1024.0) if k % 2 else (0.5, -1000.0)
        data = Dataset()
        data.file_meta = FileMetaDataset()
        data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = CTImageStorage
        data.SOPInstanceUID = data.file_meta.MediaStorageSOPInstanceUID = generate_uid()
        data.Modality, data.SeriesNumber, data.SeriesDescription, data.InstanceNumber = "CT", number, description, k + 1
        data.SeriesInstanceUID, data.StudyInstanceUID, data.FrameOfReferenceUID = series, study, frame
        data.Rows, data.Columns = volume.grid.shape[1], volume.grid.shape[0]
        data.PixelSpacing = [number_text(spacing[1]), number_text(spacing[0])]
        data.SliceThickness = number_text(spacing[2])
        axes = affine[:3, :2] / spacing[:2]
        data.ImageOrientationPatient = [number_text(x) for x in axes.T.ravel()]
        data.ImagePositionPatient = [number_text(x) for x in (affine @ [0, 0, k, 1])[:3]]
        data.RescaleSlope, data.RescaleIntercept, data.RescaleType = slope, intercept, "HU"
        data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
        data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 0
        stored = np.rint((volume.array[:, :, k].T - intercept) / slope).astype("<u2")
        data.PixelData = stored.tobytes()
        data.filename = str(folder / name)
        save(data)
        written.append(data)
    return written


def write_tomogram(volume: mph.Volume, path: Path, order=None, **changes) -> Dataset:
    """A nuclear medicine file whose frame i is the volume's plane `order[i]` of iz; `changes` are tags, None removes one.

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
    detector.ImageOrientationPatient = [number_text(x) for x in axes[:, :2].T.ravel()]
    detector.ImagePositionPatient = [number_text(x) for x in (affine @ [0, 0, order[0], 1])[:3]]
    data = Dataset()
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = NuclearMedicineImageStorage
    data.SOPInstanceUID = data.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    data.SeriesInstanceUID, data.Modality = generate_uid(), "NM"
    data.ImageType = ["DERIVED", "PRIMARY", "RECON TOMO", "EMISSION"]
    data.NumberOfFrames, data.NumberOfSlices, data.NumberOfEnergyWindows = len(order), n_z, 2  # one window for scatter
    data.FrameIncrementPointer = 0x00540080
    data.SliceVector = [int(k if way > 0 else n_z - 1 - k) + 1 for k in order]
    data.DetectorInformationSequence = [detector]
    data.SpacingBetweenSlices = number_text(along * way * spacing[2])
    data.SliceThickness = number_text(spacing[2])
    data.PixelSpacing = [number_text(spacing[1]), number_text(spacing[0])]
    data.Rows, data.Columns, data.RescaleSlope, data.RescaleIntercept = n_y, n_x, 2, 1
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 0
    data.PixelData = np.rint((volume.array[:, :, order].transpose(2, 1, 0) - 1) / 2).astype("<u2").tobytes()
    for name, value in changes.items():
        if value is None:
            delattr(data, name)
        else:
            setattr(data, name, value)
    data.filename = str(path)
    save(data)
    return data


def number_text(value: float) -> str:
    """A number in the 16 characters of a decimal string."""
    return next(text for digits in range(16, 0, -1) if len(text := f"{value:.{digits}g}") <= 16)


def save(data: Dataset) -> None:
    data.save_as(data.filename, enforce_file_format=True)


def write_frames(frames: np.ndarray, path: Path, milliseconds: int | None = None, **changes) -> Dataset:
    """A nuclear medicine file of planar frames (n, rows, columns) of counts; `changes` are tags, None removes one."""
    data = Dataset()
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = NuclearMedicineImageStorage
    data.SOPInstanceUID = data.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    data.SeriesInstanceUID, data.Modality = generate_uid(), "NM"
    data.ImageType = ["ORIGINAL", "PRIMARY", "STATIC", "EMISSION"]
    data.NumberOfFrames, data.Rows, data.Columns = frames.shape
    data.NumberOfDetectors, data.DetectorVector = len(frames), list(range(1, len(frames) + 1))
    data.FrameIncrementPointer = 0x00540020
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 0
    if milliseconds is not None:
        data.ActualFrameDuration = milliseconds
    data.PixelData = frames.astype("<u2").tobytes()
    for name, value in changes.items():
        if value is None:
            delattr(data, name)
        else:
            setattr(data, name, value)
    data.filename = str(path)
    save(data)
    return data
