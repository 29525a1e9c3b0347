"""Similarities, and the recovery of a pose."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")
pytest.importorskip("roma", reason="roma is not installed")

from mphdrr.core.exchange.diffdrr.pose_search import local_ncc, multiscale_ncc, ncc, pose_error, register_pose  # noqa: E402
from mphdrr.core.geometry.grid import Grid  # noqa: E402
from mphdrr.core.geometry.rotations import pose_matrix, se3_exp  # noqa: E402
from mphdrr.core.projector.torch_cameras import pinhole_images  # noqa: E402
from mphdrr.core.volumes.volume import Volume  # noqa: E402

from .conftest import refused  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
CHEST = ROOT.parent / "shared/data/chest_ct_3mm.nii.gz"


def test_similarity_is_1_for_another_brightness_and_contrast(rng):
    a, other = torch.tensor(rng.random((2, 3, 30, 40)))
    for similarity in (ncc, local_ncc, multiscale_ncc):
        np.testing.assert_allclose(similarity(a, 5 + 0.01 * a), 1, atol=1e-9)
        np.testing.assert_allclose(similarity(a, 5 - 3 * a), -1, atol=1e-9)
        assert similarity(a, other).shape == (3,)
        assert (similarity(a, other).abs() < 0.2).all()
    np.testing.assert_allclose(ncc(a, other)[1], np.corrcoef(a[1].ravel(), other[1].ravel())[0, 1], atol=1e-9)


def test_similarity_of_flat_images_has_gradients():
    flat = torch.full((20, 20), 3.0, requires_grad=True)
    score = multiscale_ncc(flat, torch.zeros(20, 20))
    score.backward()
    assert torch.isfinite(score) and torch.isfinite(flat.grad).all()


def test_pose_error():
    a = se3_exp(torch.tensor([1.0, 2.0, 3.0, 0.0, 0.0, 0.1], dtype=torch.float64))
    angle, apart = pose_error(a, torch.eye(4))
    assert angle == pytest.approx(0.1) and apart == pytest.approx(float(a[:3, 3].norm()))
    assert pose_error(a, a) == pytest.approx((0, 0), abs=1e-6)


@pytest.mark.long
def test_pose_of_a_camera_is_recovered(rng):
    """Balls of different size, 47 x 49 pixels: remainders at the coarse levels must not shift the image."""
    grid = Grid.centered((24, 24, 24), 4.0, (10.0, -5.0, 3.0))
    points = np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), -1)
    balls = sum(np.exp(-((points - c) ** 2).sum(-1) / (2 * w**2)) for c, w in zip(
        rng.uniform(6, 18, (6, 3)), rng.uniform(1.5, 3, 6), strict=True))  # fmt: skip
    volume = Volume(balls, grid)
    truth = pose_matrix(torch.eye(3, dtype=torch.float64), torch.tensor(grid.center - [0, 0, 200.0]))
    image = pinhole_images(volume, truth[:3, 3], truth[:3, :3], 400.0, 5.0, (47, 49), (4.0, -3.0))
    motion = se3_exp(torch.tensor([3.0, -4.0, 6.0, 0.08, -0.1, 0.05], dtype=torch.float64))
    calls = []
    found = register_pose(image, volume, motion @ truth, 400.0, 5.0, (4.0, -3.0), levels=(2, 1), steps=60,
                          progress=lambda *at: calls.append(at))  # fmt: skip
    angle, apart = pose_error(found.pose, truth, grid.center)
    assert np.degrees(angle) < 0.5 and apart < 1.5  # 7.9 degrees and 7.8 mm at the start
    assert calls[-1] == (120, 120) and len(found.similarities) == 120


def test_bad_input_is_one_clear_line():
    volume = Volume(np.ones((4, 4, 4)), Grid.centered(4, 1.0))
    for call, word in (
        (lambda: register_pose(torch.ones(3), volume, torch.eye(4), 10, 1), "n_v x n_u"),
        (lambda: register_pose(torch.ones(3, 3), volume, torch.eye(3), 10, 1), "4 x 4"),
        (lambda: register_pose(torch.ones(3, 3), torch.ones(4, 4, 4), torch.eye(4), 10, 1), "grid"),
    ):
        refused(call, word)


@pytest.mark.long
@pytest.mark.skipif(not CHEST.is_file(), reason="the chest CT is not there")
def test_example_on_the_chest_ct(monkeypatch, capsys):
    """From 10 degrees and 20 mm away to within 0.2 degrees and 0.5 mm."""
    monkeypatch.setattr(sys, "argv", ["register_pose.py", str(CHEST), "--pixels", "48"])
    runpy.run_path(str(ROOT / "examples/register_pose.py"), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    start, found = (dict(zip(("degrees", "mm"), (float(x) for x in (line.split()[1], line.split()[3])), strict=True))
                    for line in lines[1:])  # fmt: skip
    assert start["degrees"] == pytest.approx(10, abs=0.01) and start["mm"] == pytest.approx(20, abs=0.5)
    assert found["degrees"] < 0.2 and found["mm"] < 0.5
