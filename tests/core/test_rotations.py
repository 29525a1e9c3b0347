"""Rotations: against scipy, round trips, gradients."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")
pytest.importorskip("roma", reason="roma is not installed")
transform = pytest.importorskip("scipy.spatial.transform", reason="scipy is not installed")

from mphdrr.core.errors import InputError  # noqa: E402
from mphdrr.core.geometry import rotations  # noqa: E402

CONVENTIONS = [
    "".join(c) for axes in ("XYZ", "xyz") for c in itertools.product(axes, repeat=3) if c[1] not in (c[0], c[2])
]
PARAMETERIZATIONS = [name for name in rotations.SIZES if name != "euler_angles"]


@pytest.fixture
def rotation(rng):
    return transform.Rotation.random(50, random_state=1)


def tensor(array):
    return torch.tensor(np.asarray(array), dtype=torch.float64)


def close(a, b, tolerance=1e-9):
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), atol=tolerance)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_euler_angles_are_those_of_scipy(convention, rotation):
    angles = rotation.as_euler(convention)
    close(rotations.rotation_matrix(tensor(angles), "euler_angles", convention), rotation.as_matrix())
    degrees = rotations.rotation_matrix(tensor(np.degrees(angles)), "euler_angles", convention, degrees=True)
    close(degrees, rotation.as_matrix())
    close(rotations.rotation_parameters(degrees, "euler_angles", convention), angles, 1e-6)


def test_axis_angle_and_quaternion_are_those_of_scipy(rotation):
    close(rotations.rotation_matrix(tensor(rotation.as_rotvec()), "axis_angle"), rotation.as_matrix())
    quaternion = 3 * rotation.as_quat()[:, [3, 0, 1, 2]]
    close(rotations.rotation_matrix(tensor(quaternion), "quaternion"), rotation.as_matrix())


@pytest.mark.parametrize("parameterization", PARAMETERIZATIONS)
def test_round_trip(parameterization, rotation):
    matrix = tensor(rotation.as_matrix())
    parameters = rotations.rotation_parameters(matrix, parameterization)
    if parameterization != "matrix":
        assert parameters.shape == (50, rotations.SIZES[parameterization])
    close(rotations.rotation_matrix(parameters, parameterization), matrix)
    one = rotations.rotation_matrix(parameters[3], parameterization)  # without a batch
    close(one, matrix[3])
    close(rotations.rotation_matrix(parameters.float(), parameterization), matrix, 1e-5)


@pytest.mark.parametrize("parameterization", PARAMETERIZATIONS)
def test_gradients(parameterization, rotation, rng):
    parameters = rotations.rotation_parameters(tensor(rotation.as_matrix()[:4]), parameterization)
    if parameterization not in ("matrix", "axis_angle"):
        parameters = parameters + tensor(rng.normal(size=tuple(parameters.shape))) * 0.05
    matrix = rotations.rotation_matrix(parameters, parameterization)
    if parameterization != "matrix":
        close(matrix @ matrix.mT, np.broadcast_to(np.eye(3), (4, 3, 3)))
        close(torch.linalg.det(matrix), np.ones(4))
    parameters.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: rotations.rotation_matrix(x, parameterization), (parameters,), atol=1e-4)


def test_no_rotation_has_gradients(rng):
    for name in ("axis_angle", "euler_angles"):
        zero = torch.zeros((1, 3), dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(
            lambda x, name=name: rotations.rotation_matrix(x, name, "ZXY"), (zero,), atol=1e-4
        )
    zero = torch.zeros((1, 6), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rotations.se3_exp, (zero,))
    close(rotations.se3_log(rotations.se3_exp(zero.detach())), zero.detach())


def test_se3_logarithm(rotation, rng):
    logarithm = tensor(np.c_[rng.normal(size=(50, 3)) * 100, rotation.as_rotvec()])
    pose = rotations.se3_exp(logarithm)
    close(pose[:, :3, :3], rotation.as_matrix())
    close(pose[:, 3], np.tile([0, 0, 0, 1], (50, 1)))
    close(rotations.se3_log(pose), logarithm, 1e-6)
    logarithm[:, 3:] = 0
    close(rotations.se3_exp(logarithm)[:, :3, 3], logarithm[:, :3])
    logarithm.requires_grad_()
    assert torch.autograd.gradcheck(rotations.se3_exp, (logarithm[:3],))


def test_bad_input_is_one_clear_line():
    angles = torch.zeros(2, 3)
    for arguments, word in (
        ((angles, "euler"), "axis_angle"),
        ((angles, "euler_angles"), "ZXY"),
        ((angles, "euler_angles", "XXY"), "XXY"),
        ((angles, "euler_angles", "Xyz"), "Xyz"),
        ((angles, "quaternion"), "x 4"),
        ((angles, "matrix"), "3 x 3"),
    ):
        with pytest.raises(InputError) as error:
            rotations.rotation_matrix(*arguments)
        assert word in str(error.value) and "\n" not in str(error.value)
