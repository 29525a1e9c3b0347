"""Headers of NIfTI, NRRD and MetaImage: a sform of zeros, an offset inside the header, a fourth axis of one element.

https://github.com/nipy/nibabel/issues/182 (a sform of zeros); NIfTI-1, NRRD and MetaIO as published.
"""

from __future__ import annotations

import struct

import numpy as np
import pytest

import mphdrr.core as mph

from ..core.conftest import refused

VALUES = np.arange(60, dtype=np.float32).reshape(3, 4, 5)


@pytest.mark.parametrize("size, angle", [((2, 3, 4), 0.0), ((1, 1, 2), 0.3), ((0.5, 2, 0.7), -1.1)])
def test_a_sform_of_zeros_is_none(tmp_path, size, angle):
    nibabel = pytest.importorskip("nibabel")
    affine = mph.euler_pose(angle, 0.1, 0.0) @ np.diag([*size, 1.0])
    affine[:3, 3] = 4, 5, 6
    image = nibabel.Nifti1Image(VALUES, None)
    image.header.set_qform(affine, 1)
    image.header["sform_code"] = 1
    for row in "xyz":
        image.header[f"srow_{row}"] = 0
    nibabel.save(image, tmp_path / "v.nii")
    np.testing.assert_allclose(mph.read_volume(tmp_path / "v.nii").grid.affine, affine, atol=1e-5)


@pytest.mark.parametrize("offset", [0, 1, 100, 348, 351])
def test_voxels_do_not_begin_inside_the_header(tmp_path, offset):
    nibabel = pytest.importorskip("nibabel")
    path = tmp_path / "v.nii"
    nibabel.save(nibabel.Nifti1Image(VALUES, np.eye(4)), path)
    content = bytearray(path.read_bytes())
    content[108:112] = struct.pack("<f", offset)
    path.write_bytes(content)
    refused(lambda: mph.read_volume(path), f"{offset}", "low|352")


@pytest.mark.parametrize("kinds", [["list"], ["time"], ["???"]])
@pytest.mark.parametrize("axis", [0, 3])
def test_nrrd_of_one_volume_may_have_a_fourth_axis(tmp_path, kinds, axis):
    nrrd = pytest.importorskip("nrrd")
    all_kinds, steps = ["domain"] * 3, [[2.0, 0, 0], [0, 3.0, 0], [0, 0, 4.0]]
    all_kinds[axis:axis], steps[axis:axis] = kinds, [[np.nan] * 3]
    header = {"space": "RAS", "space directions": np.array(steps), "space origin": [1, 2, 3], "kinds": all_kinds}
    nrrd.write(str(tmp_path / "v.nrrd"), np.expand_dims(VALUES, axis), header)
    volume = mph.read_volume(tmp_path / "v.nrrd")
    np.testing.assert_array_equal(volume.array, VALUES)
    np.testing.assert_allclose(volume.grid.affine, [[2, 0, 0, 1], [0, 3, 0, 2], [0, 0, 4, 3], [0, 0, 0, 1]])
    nrrd.write(str(tmp_path / "v.nrrd"), np.repeat(np.expand_dims(VALUES, axis), 2, axis), header)
    refused(lambda: mph.read_volume(tmp_path / "v.nrrd"), "expected a 3-D image")


@pytest.mark.parametrize("matrix", ["1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "0 1 0 0 1 0 0 0 0 0 1 0 0 0 0 1", ""])
def test_meta_image_of_one_volume_may_have_a_fourth_axis(tmp_path, matrix):
    fields = {
        "ObjectType": "Image", "NDims": "4", "BinaryData": "True", "BinaryDataByteOrderMSB": "False",
        "TransformMatrix": matrix, "Offset": "5 6 7 0", "ElementSpacing": "2 3 4 1", "DimSize": "3 4 5 1",
        "ElementType": "MET_FLOAT", "ElementDataFile": "LOCAL",
    }  # fmt: skip
    text = "".join(f"{key} = {value}\n" for key, value in fields.items() if value)
    (tmp_path / "v.mha").write_bytes(text.encode() + VALUES.tobytes(order="F"))
    volume = mph.read_volume(tmp_path / "v.mha")
    np.testing.assert_array_equal(volume.array, VALUES)
    assert sorted(volume.grid.spacing.tolist()) == [2, 3, 4] and volume.grid.affine[:3, 3].tolist() == [-5, -6, 7]
    assert (abs(volume.grid.affine[0, 1]) == 3) == matrix.startswith("0")
    (tmp_path / "v.mha").write_bytes(text.replace("5 1\n", "5 2\n").encode() + 2 * VALUES.tobytes(order="F"))
    refused(lambda: mph.read_volume(tmp_path / "v.mha"), "expected a 3-D image")
