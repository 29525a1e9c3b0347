"""The two set-ups of a system's radiographs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mphdrr.core.errors import InputError
from mphdrr.core.geometry.presets import c_arm_views, pinhole_views


def test_pinhole_views_start_at_the_pinholes(system):
    views = pinhole_views(system, shape=(30, 40), magnification=7.0)
    np.testing.assert_allclose(views.sources, system.centers)
    depth = np.einsum("mi,mi->m", views.detector_centers - views.sources, system.principal_rays)
    np.testing.assert_allclose(depth, 7 * system.collimator_length)


def test_c_arm_stands_around_the_isocentre(system):
    """Source and detector are 5 l from it on either side, the source on the pinhole's."""
    views = c_arm_views(system, shape=(30, 40), pitch=(1.0, 2.0))
    l = system.collimator_length
    np.testing.assert_allclose(np.linalg.norm(views.sources, axis=1), 5 * l)
    np.testing.assert_allclose(views.detector_centers, -views.sources)
    np.testing.assert_allclose(np.cross(views.sources, system.centers), 0, atol=1e-9)
    assert np.all(np.einsum("mi,mi->m", views.sources, system.centers) > 0)
    np.testing.assert_allclose(np.linalg.norm(views.u_steps, axis=1), 1)
    np.testing.assert_allclose(np.linalg.norm(views.v_steps, axis=1), 2)


def test_c_arm_with_diffdrrs_elevation_stands_at_the_mirror_images_in_z(system):
    """Its views of a system are the views of the mirrored system, and of it mirrored the system's own."""
    mirrored = replace(system, centers=system.centers * [1, 1, -1])
    for own, other in ((system, mirrored), (mirrored, system)):
        views, expected = c_arm_views(own, (3, 4), 1.5, elevation="diffdrr"), c_arm_views(other, (3, 4), 1.5)
        for name in ("sources", "detector_centers", "u_steps", "v_steps"):
            np.testing.assert_allclose(getattr(views, name), getattr(expected, name), atol=1e-12)
    np.testing.assert_allclose(c_arm_views(system, (3, 4), 1.5).sources[:, 2] * system.centers[:, 2] > 0, True)


def test_the_two_agree_on_the_isocentre_and_on_which_side_is_which(system):
    """A point beside the isocentre is displaced in the same direction, by each set-up's own magnification."""
    point = np.array([0.0, 0.0, 0.0, 1.0])
    places = []
    for views in (pinhole_views(system, (101, 101), pitch=1.0), c_arm_views(system, (101, 101), pitch=1.0)):
        for offset, shift in ((0.0, 0.0), (1.0, 1.0)):
            for m in range(len(system)):
                moved = point.copy()
                moved[:3] += offset * system.frames()[m, 0] + shift * system.frames()[m, 1]
                x = views.projection_matrices()[m] @ moved
                places.append(x[:2] / x[2] - 50)
    places = np.array(places).reshape(2, 2, len(system), 2)
    np.testing.assert_allclose(places[:, 0], 0, atol=1e-9)
    l, b = system.collimator_length, system.pinhole_distance
    np.testing.assert_allclose(places[0, 1], np.repeat((10 * l / b)[:, None], 2, 1))
    np.testing.assert_allclose(places[1, 1], 2)


def test_bad_input_is_one_clear_line(system):
    for arguments, word in (
        ({"pitch": 0.0}, "pitch"),
        ({"lengths": -1.0}, "lengths"),
        ({"shape": (0, 3)}, "shape"),
        ({"elevation": "negative"}, "elevation"),
    ):
        with pytest.raises(InputError) as error:
            c_arm_views(system, **arguments)
        assert word in str(error.value) and "\n" not in str(error.value)
