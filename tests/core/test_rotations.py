"""Rotations: against scipy, round trips, gradients."""

import functools
import itertools

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")
pytest.importorskip("roma", reason="roma is not installed")
transform = pytest.importorskip("scipy.spatial.transform", reason="scipy is not installed")

from mphdrr.core.geometry import rotations  # noqa: E402

from .conftest import refused  # noqa: E402

CONVENTIONS = ["".join(c) for axes in ("XYZ", "xyz") for c in itertools.product(axes, repeat=3) if c[1] not in c[::2]]
PARAMETERIZATIONS = [name for name in rotations.SIZES if name != "euler_angles"]


ROTATION = transform.Rotation.random(50, random_state=1)
MATRICES = torch.from_numpy(ROTATION.as_matrix())


def close(a, b, tolerance=1e-9):
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), atol=tolerance)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_euler_angles_are_those_of_scipy(convention):
    angles = torch.from_numpy(ROTATION.as_euler(convention))
    close(rotations.rotation_matrix(angles, "euler_angles", convention), MATRICES)
    degrees = rotations.rotation_matrix(torch.rad2deg(angles), "euler_angles", convention, degrees=True)
    close(degrees, MATRICES)
    close(rotations.rotation_parameters(degrees, "euler_angles", convention), angles, 1e-6)


def test_axis_angle_and_quaternion_are_those_of_scipy():
    close(rotations.rotation_matrix(torch.from_numpy(ROTATION.as_rotvec()), "axis_angle"), MATRICES)
    quaternion = 3 * torch.from_numpy(ROTATION.as_quat()[:, [3, 0, 1, 2]])
    close(rotations.rotation_matrix(quaternion, "quaternion"), MATRICES)


@pytest.mark.parametrize("parameterization", PARAMETERIZATIONS)
def test_round_trip(parameterization):
    parameters = rotations.rotation_parameters(MATRICES, parameterization)
    if parameterization != "matrix":
        assert parameters.shape == (50, rotations.SIZES[parameterization])
    close(rotations.rotation_matrix(parameters, parameterization), MATRICES)
    close(rotations.rotation_matrix(parameters[3], parameterization), MATRICES[3])  # without a batch
    close(rotations.rotation_matrix(parameters.float(), parameterization), MATRICES, 1e-5)


@pytest.mark.parametrize("parameterization", PARAMETERIZATIONS)
def test_gradients(parameterization, rng):
    parameters = rotations.rotation_parameters(MATRICES[:4], parameterization)
    if parameterization not in ("matrix", "axis_angle"):
        parameters = parameters + torch.from_numpy(rng.normal(size=tuple(parameters.shape))) * 0.05
    matrix = rotations.rotation_matrix(parameters, parameterization)
    if parameterization != "matrix":
        close(matrix @ matrix.mT, np.broadcast_to(np.eye(3), (4, 3, 3)))
        close(torch.linalg.det(matrix), np.ones(4))
    parameters.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: rotations.rotation_matrix(x, parameterization), (parameters,), atol=1e-4)


def test_no_rotation_has_gradients():
    zero = torch.zeros((1, 6), dtype=torch.float64, requires_grad=True)
    for name in ("axis_angle", "euler_angles"):
        matrices = functools.partial(rotations.rotation_matrix, parameterization=name, convention="ZXY")
        assert torch.autograd.gradcheck(matrices, (zero[:, :3],), atol=1e-4)
    assert torch.autograd.gradcheck(rotations.se3_exp, (zero,))
    close(rotations.se3_log(rotations.se3_exp(zero.detach())), zero.detach())


def test_se3_logarithm(rng):
    logarithm = torch.from_numpy(np.c_[rng.normal(size=(50, 3)) * 100, ROTATION.as_rotvec()])
    pose = rotations.se3_exp(logarithm)
    close(pose[:, :3, :3], MATRICES)
    close(pose[:, 3], np.tile([0, 0, 0, 1], (50, 1)))
    close(rotations.se3_log(pose), logarithm, 1e-6)
    logarithm[:, 3:] = 0
    close(rotations.se3_exp(logarithm)[:, :3, 3], logarithm[:, :3])
    logarithm.requires_grad_()
    assert torch.autograd.gradcheck(rotations.se3_exp, (logarithm[:3],))


def test_bad_input_is_one_clear_line():
    angles = torch.zeros(2, 3)
    for arguments, word in (
        (("euler",), "axis_angle"),
        (("euler_angles",), "ZXY"),
        (("euler_angles", "XXY"), "XXY"),
        (("euler_angles", "Xyz"), "Xyz"),
        (("quaternion",), "x 4"),
        (("matrix",), "3 x 3"),
    ):
        refused(lambda arguments=arguments: rotations.rotation_matrix(angles, *arguments), word)
