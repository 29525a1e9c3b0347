"""The two set-ups of a system's radiographs."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import main
from mphdrr.core.runs.run_recipe import recipe_views

from .conftest import refused


def test_pinhole_views_start_at_the_pinholes(system):
    views = mph.pinhole_views(system, shape=(30, 40), magnification=7.0)
    np.testing.assert_allclose(views.sources, system.centers)
    depth = np.einsum("mi,mi->m", views.detector_centers - views.sources, system.principal_rays)
    np.testing.assert_allclose(depth, 7 * system.collimator_length)


def test_c_arm_stands_around_the_isocentre(system):
    """Source and detector are 5 l from it on either side, the source on the pinhole's."""
    views = mph.c_arm_views(system, shape=(30, 40), pitch=(1.0, 2.0))
    l = system.collimator_length
    np.testing.assert_allclose(np.linalg.norm(views.sources, axis=1), 5 * l)
    np.testing.assert_allclose(views.detector_centers, -views.sources)
    np.testing.assert_allclose(np.cross(views.sources, system.centers), 0, atol=1e-9)
    assert np.all(np.einsum("mi,mi->m", views.sources, system.centers) > 0)
    np.testing.assert_allclose(np.linalg.norm(views.u_steps, axis=1), 1)
    np.testing.assert_allclose(np.linalg.norm(views.v_steps, axis=1), 2)


def test_c_arm_with_diffdrrs_elevation_stands_at_the_mirror_images_in_z(system):
    """Its views of a system are the views of the mirrored system, and of it mirrored the system's own."""
    mirror = replace(system, centers=system.centers * [1, 1, -1])
    for first, second in ((system, mirror), (mirror, system)):
        views, expected = mph.c_arm_views(first, (3, 4), 1.5, elevation="diffdrr"), mph.c_arm_views(second, (3, 4), 1.5)
        for name in ("sources", "detector_centers", "u_steps", "v_steps"):
            np.testing.assert_allclose(getattr(views, name), getattr(expected, name), atol=1e-12)
    np.testing.assert_allclose(mph.c_arm_views(system, (3, 4), 1.5).sources[:, 2] * system.centers[:, 2] > 0, True)


def test_the_two_agree_on_the_isocentre_and_on_which_side_is_which(system):
    """A point beside the isocentre is displaced in the same direction, by each set-up's own magnification."""
    system = system.replace(tilt=0.0)
    l, b = system.collimator_length, system.pinhole_distance
    points = np.stack([0 * system.centers, system.frames()[:, 0] + system.frames()[:, 1]], axis=2)
    points = np.concatenate([points, np.ones((12, 1, 2))], axis=1)
    for make, magnification in ((mph.pinhole_views, 10 * l / b), (mph.c_arm_views, 2.0)):
        x = make(system, (101, 101), pitch=1.0).projection_matrices() @ points
        places = x[:, :2] / x[:, 2:] - 50
        np.testing.assert_allclose(places[:, :, 0], 0, atol=1e-9)
        np.testing.assert_allclose(places[:, :, 1].T, magnification * np.ones((2, 12)))


CONTRADICTIONS = [
    # Of crystals of 50 mm: plane, magnification, pixels (n_v, n_u), their size, what is said.
    ("virtual", 10.0, (500, 500), 2.5, "500 pixels of 2.5 mm are 1250 mm, but the virtual detector's side is 500 mm"),
    ("virtual", 8.0, (120, 150), 3.0, "150 pixels of 3 mm are 450 mm, but the virtual detector's side is 400 mm"),
    ("virtual", 10.0, (256, 256), 0.2, "256 pixels of 0.2 mm are 51.2 mm, but the virtual detector's side is 500 mm"),
    ("virtual", 10.0, (200, 400), (1.2, 5.0), "200 pixels of 5 mm are 1000 mm, but the virtual detector's side is 500 mm"),
    ("real", 10.0, (64, 64), 1.0, "64 pixels of 1 mm are 64 mm, but the real detector's side is 50 mm"),
    ("real", 4.0, (250, 250), 2.0, "250 pixels of 2 mm are 500 mm, but the real detector's side is 50 mm"),
]  # fmt: skip


@pytest.mark.parametrize(("plane", "magnification", "shape", "pitch", "said"), CONTRADICTIONS)
def test_pixels_that_contradict_the_detectors_side_are_warned_of_by_both_numbers(
    plane, magnification, shape, pitch, said, scanner
):
    """In Python, in recipes, on the command line; the views are those that were asked for."""
    with pytest.warns(mph.InputWarning) as caught:
        views = scanner.views(shape, plane, magnification, pitch)
    assert [str(warning.message) for warning in caught] == [said]
    pitch_u, pitch_v = np.broadcast_to(pitch, 2) * (magnification if plane == "real" else 1)
    np.testing.assert_allclose(np.linalg.norm(views.u_steps, axis=1), pitch_u)
    np.testing.assert_allclose(np.linalg.norm(views.v_steps, axis=1), pitch_v)
    if np.ndim(pitch) == 0:
        names, (rows, columns) = ("plane", "magnification", "rows", "columns", "pitch"), shape
        entries = dict(zip(names, (plane, magnification, rows, columns, pitch), strict=True))
        with pytest.warns(mph.InputWarning, match=re.escape(said)):
            recipe_views(mph.Recipe({f"detector.{name}": value for name, value in entries.items()}), scanner)


def test_c_arms_warn_of_pixels_too_and_each_modules_own_side_matters(scanner):
    one = replace(scanner, detector_side=np.where(scanner.numbers == 7, 20.0, 50.0))
    arm, wide = partial(mph.c_arm_views, scanner), "500 pixels of 2.5 mm are 1250 mm, but the side, 10 Ld, is 500 mm"
    for call, said in (
        (lambda: arm((500, 500), 2.5), wide),
        (lambda: arm((500, 500), 2.5, elevation="diffdrr"), wide),
        (lambda: arm((200, 300), (1.5, 1.4), 6.0), "300 pixels of 1.5 mm are 450 mm, but the side, 6 Ld, is 300 mm"),
        (
            lambda: one.views((100, 100), "real", pitch=0.5),
            "of 0.5 mm are 50 mm, but the real detector's side is 20 mm",
        ),
    ):
        with pytest.warns(mph.InputWarning, match=said):
            call()


@pytest.mark.filterwarnings("error")
def test_the_users_own_pixels_are_not_warned_of(scanner, system):
    """250 or 256 pixels of 1 or 2 mm: the middle half, "FOV", or all of it, "Wide FOV"; and what has no pixel size."""
    for n in (250, 256):
        for pitch in (1.0, 2.0, (2.0, 1.0)):
            scanner.views((n, n), pitch=pitch)
            mph.c_arm_views(scanner, (n, n), pitch)
    scanner.views((64, 64), "real", pitch=0.8)
    for one in (scanner, system):
        one.views((7, 9), "real", 3.0)
        mph.pinhole_views(one, (30, 20))
        mph.c_arm_views(one)


def test_the_command_line_warns_of_contradicting_pixels(workbook, tmp_path, capsys):
    words = ["--size", "40", "30", "--pitch", "25", "--modules", "3-4", "--voxels", "12", "--spacing", "8"]
    assert main(["project", str(workbook), *words, "-o", str(tmp_path / "run.npz")]) == 0
    said = "30 pixels of 25 mm are 750 mm, but the virtual detector's side is 500 mm"
    assert said in " ".join(capsys.readouterr().err.split())


def test_bad_input_is_one_clear_line(system):
    for name, value in (("pitch", 0.0), ("lengths", -1.0), ("shape", (0, 3)), ("elevation", "negative")):
        refused(lambda name=name, value=value: mph.c_arm_views(system, **{name: value}), name)
