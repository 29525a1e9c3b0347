"""Write volumes as DICOM, by pydicom: activity and attenuation as reconstructed tomograms (NM), CT numbers as CT slices.

Values are stored in 16 bits: as they are if they are whole numbers of the volume's unit that fit, else in steps of the
largest absolute value / 65535, or / 32767 where some are negative.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array, Floats
from ...errors import InputError, first_line, reading
from ...files import AnyPath, new_folder, replacing, require_file
from ...version import VERSION
from ..volume import Volume
from .contents import RAS_FROM_LPS

_TOMOGRAMS = {
    "activity": ("EMISSION", 1e3, "Bq/mL", "becquerels per milliliter"),
    "mu": ("TRANSMISSION", 10.0, "/cm", "per centimeter"),
}
"""Value 4 of ImageType, factor from the volume's unit to the file's, and UCUM's code and name of that unit, by quantity."""
_RIGHT_ANGLE = 1e-5  # cosine of the angle between two axes; of affines in float32 it is about 1e-7
_OPTIONAL = """
    StudyInstanceUID StudyDescription SeriesDescription SeriesDate SeriesTime BodyPartExamined Laterality ProtocolName
    OperatorsName PerformingPhysicianName InstitutionName StationName AcquisitionDate AcquisitionTime
"""
_REQUIRED = """
    PatientName PatientID PatientBirthDate PatientSex StudyDate StudyTime StudyID AccessionNumber ReferringPhysicianName
    SeriesNumber PatientPosition PositionReferenceIndicator AcquisitionNumber
"""
_REQUIRED_OF = {
    "CT": "KVP",
    "NM": """
        CountsAccumulated EnergyWindowInformationSequence RadiopharmaceuticalInformationSequence
        RotationInformationSequence PatientOrientationCodeSequence PatientGantryRelationshipCodeSequence
    """,
}
"""Keywords, of all files and by modality, that a template or the user states. Required ones may be empty (type 2)."""


def write(volume: Volume, path: Path, template: AnyPath | None = None, tags: Mapping[str, Any] | None = None) -> None:
    """Write CT numbers as a new folder `path` with a file for each slice, and other volumes as one file.

    Tags of patient, study and series are those of the DICOM file `template`, with the values of `tags`, by keyword.
    """
    if volume.quantity not in (*_TOMOGRAMS, "hu"):
        raise InputError(f"DICOM holds {', '.join(_TOMOGRAMS)} or hu, not {volume.quantity}: choose another format")
    affine, array = RAS_FROM_LPS @ volume.grid.affine, volume.array
    spacing = volume.grid.spacing
    axes = affine[:3, :3] / spacing
    if np.abs(axes.T @ axes - np.eye(3)).max() > _RIGHT_ANGLE:
        raise InputError("its grid is sheared, DICOM's have axes at right angles: resample it to one of these")
    position = affine[:3, 3]
    if np.linalg.det(axes) < 0:  # write the last slice first, along the normal of rows and columns
        position = position + (array.shape[2] - 1) * affine[:3, 2]
        axes, array = axes * [1, 1, -1], array[:, :, ::-1]
    kind, factor, code, meaning = _TOMOGRAMS.get(volume.quantity, ("AXIAL", 1.0, "HU", ""))
    stored, slope = to_16_bits(array, factor)
    header = new_header("CT" if code == "HU" else "NM", template, tags or {})
    add_pixels(header, stored, slope, spacing, code, meaning)
    set_tags(header, SliceThickness=decimals(spacing[2:])[0], **({"ImageComments": volume.note} if volume.note else {}))
    places = [_place(position + k * spacing[2] * axes[:, 2], axes) for k in range(len(stored))]
    if volume.quantity == "hu":
        set_tags(header, ImageType=["DERIVED", "SECONDARY", kind], RescaleType=code)
        with new_folder(path) as folder:
            for k, (pixels, place) in enumerate(zip(stored, places, strict=True), 1):
                save_image(set_tags(header, **place), k, pixels, folder / f"{k:04d}.dcm")
        return
    detector = set_tags(None, CollimatorType="UNKN", FocalDistance=None, **places[0])
    set_tags(
        header, ImageType=["DERIVED", "PRIMARY", "RECON TOMO", kind], NumberOfFrames=len(stored),
        NumberOfSlices=len(stored), SliceVector=list(range(1, len(stored) + 1)), FrameIncrementPointer=0x00540080,
        SpacingBetweenSlices=decimals(spacing[2:])[0], NumberOfEnergyWindows=1, NumberOfDetectors=1, NumberOfRotations=1,
        DetectorInformationSequence=[detector],
    )  # fmt: skip
    if len(header.RotationInformationSequence) > 1:  # a tomogram is of one rotation (C.8.4.8.1.5)
        header.RotationInformationSequence = []
    with replacing(path) as temporary:
        save_image(header, 1, stored, temporary)


def to_16_bits(array: Array, factor: float) -> tuple[Array, Any]:
    """Return whole numbers (n_z, n_y, n_x) for values (n_x, n_y, n_z), and the slope: value * factor = slope * number."""
    is_signed = bool(array.min() < 0)
    largest = 32767 if is_signed else 65535
    peak = float(np.abs(array).max())
    is_whole = peak <= largest and np.array_equal(array, np.rint(array))
    slope = decimals([factor if is_whole else peak / largest * factor])[0]
    stored = np.empty(array.shape[::-1], "<i2" if is_signed else "<u2")
    for k, pixels in enumerate(stored):
        pixels[:] = np.clip(np.rint(array[:, :, k].T.astype(np.float64) * (factor / slope)), -largest, largest)
    return stored, slope


def add_pixels(header: Any, stored: Array, slope: Any, spacing: Floats, code: str, meaning: str) -> None:
    """Add the tags of 16-bit pixels (n, rows, columns) of this spacing along rows and columns, mm: value = slope * number.

    `code` and `meaning` are UCUM's for the unit of the values; HU are CT numbers.
    """
    is_signed = stored.dtype.kind == "i"
    set_tags(
        header, Rows=stored.shape[1], Columns=stored.shape[2], BitsAllocated=16, BitsStored=16, HighBit=15,
        PixelRepresentation=int(is_signed), SamplesPerPixel=1, PhotometricInterpretation="MONOCHROME2",
        PixelSpacing=decimals(spacing[1::-1]), RescaleSlope=slope, RescaleIntercept=0,
    )  # fmt: skip
    if code == "HU":
        header.RescaleType = code
        return
    unit = set_tags(None, CodeValue=code, CodingSchemeDesignator="UCUM", CodeMeaning=meaning)
    values = set_tags(
        None, RealWorldValueSlope=float(slope), RealWorldValueIntercept=0.0, MeasurementUnitsCodeSequence=[unit],
        LUTLabel=code, LUTExplanation=meaning,
    )  # fmt: skip
    for name, limit in zip(("First", "Last"), (np.iinfo(stored.dtype).min, np.iinfo(stored.dtype).max), strict=True):
        values.add_new(f"RealWorldValue{name}ValueMapped", "SS" if is_signed else "US", limit)
    header.RealWorldValueMappingSequence = [values]


def _place(position: Floats, axes: Floats) -> dict[str, Any]:
    """Return the tags of an image's place: centre of its first pixel, mm, and unit axes as columns, both LPS."""
    return {"ImagePositionPatient": decimals(position), "ImageOrientationPatient": decimals(axes[:, :2].T.ravel())}


def new_header(modality: str, template: AnyPath | None, tags: Mapping[str, Any]) -> Any:
    """Return a data set with the tags of patient, study and series: empty ones, those of a template, those given."""
    import pydicom
    from pydicom.datadict import dictionary_VR, tag_for_keyword
    from pydicom.uid import CTImageStorage, NuclearMedicineImageStorage, generate_uid

    required = f"{_REQUIRED} {_REQUIRED_OF[modality]}".split()
    keywords = {*required, *_OPTIONAL.split()}
    data = set_tags(None, **{keyword: [] if keyword.endswith("Sequence") else None for keyword in required})
    set_tags(data, StudyInstanceUID=generate_uid(), FrameOfReferenceUID=generate_uid())
    if template is not None:
        with reading(template, "DICOM"):
            source = pydicom.dcmread(require_file(template), stop_before_pixels=True)
            source.decode()
            data.update({e.tag: e for e in source if e.tag.group == 0x10 or e.keyword in keywords})
    for keyword, value in tags.items():
        tag = tag_for_keyword(keyword) or 0
        if tag >> 16 != 0x10 and keyword not in {*keywords, "FrameOfReferenceUID"}:
            raise InputError(f"tag {keyword}: expected one of patient, study or series, such as PatientName")
        try:
            data[tag] = pydicom.DataElement(tag, dictionary_VR(tag), value, validation_mode=pydicom.config.RAISE)
        except (ValueError, TypeError) as error:
            raise InputError(f"tag {keyword}: {first_line(error).partition(' Please')[0]}") from None
    storage = CTImageStorage if modality == "CT" else NuclearMedicineImageStorage
    return set_tags(
        data, SpecificCharacterSet="ISO_IR 192", SOPClassUID=storage, Modality=modality, Manufacturer="mphDRR",
        SoftwareVersions=VERSION, SeriesInstanceUID=generate_uid(),
    )  # fmt: skip


def parse_tags(texts: Iterable[str]) -> dict[str, str]:
    """Return the values of tags by keyword, from texts such as ``PatientName=Doe^Jo``; empty texts are left out."""
    pairs = [text.partition("=") for text in texts if text.strip()]
    for keyword, equals, _ in pairs:
        if not equals:
            raise InputError(f"tag {keyword.strip()!r}: expected KEYWORD=VALUE, such as PatientName=Doe^Jo")
    return {keyword.strip(): value.strip() for keyword, _, value in pairs}


def save_image(data: Any, number: int, pixels: Array, path: Path) -> None:
    """Write a data set with these pixels as instance `number` of its series to a file."""
    from pydicom.dataset import FileMetaDataset
    from pydicom.uid import ExplicitVRLittleEndian, generate_uid

    data.file_meta = set_tags(FileMetaDataset(), TransferSyntaxUID=ExplicitVRLittleEndian)
    data.add_new("PixelData", "OW", pixels.tobytes())
    set_tags(data, SOPInstanceUID=generate_uid(), InstanceNumber=number).save_as(path, enforce_file_format=True)


def set_tags(data: Any, **tags: Any) -> Any:
    """Set tags by keyword in a data set, a new one for None, and return it."""
    from pydicom.dataset import Dataset

    data = Dataset() if data is None else data
    for keyword, value in tags.items():
        setattr(data, keyword, value)
    return data


def decimals(numbers: Any) -> list[Any]:
    """Return numbers as DICOM's decimal strings, of up to 16 characters."""
    from pydicom.valuerep import DSfloat, format_number_as_ds

    return [DSfloat(format_number_as_ds(float(x))) for x in numbers]
