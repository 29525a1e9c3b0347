"""A column is one row of its table; modules may be tilted and have crystals of their own materials."""

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.geometry.columns import Column

from .conftest import refused
from .test_monte_carlo import rodrigues

NEW = [
    (Column("serial", "serial", kind="text", blank=""), [f"S/N {n}, µ" for n in range(12)]),
    (Column("g", "guard_ring", plausible=(0.1, 9), blank=1.5, help="g: guard ring"), np.linspace(1, 2, 12)),
    (Column("side", "fan_side", kind="choice", choices=("left", "right"), blank="left"), ["left", "right"] * 6),
    (Column("row", "asic_row", kind="whole", blank=0), np.arange(12)),
]


@pytest.mark.parametrize(("column", "values"), NEW, ids=lambda value: getattr(value, "field", ""))
def test_a_column_is_one_row(column, values, system, tmp_path, monkeypatch):
    """Its values are the scanner's, of parts of it too, and are kept in run files and in JSON."""
    monkeypatch.setattr(mph.PinholeSystem, "columns", mph.PinholeSystem.columns.with_columns(column))
    blank = getattr(mph.PinholeSystem(system.centers, 2.0, 60.0, 50.0, 10.0, 75.0), column.field)
    assert blank.tolist() == [column.blank] * 12
    scanner = system.replace(**{column.field: values})
    assert getattr(scanner[3:5], column.field).tolist() == list(values[3:5])
    mph.write_geometry(scanner, tmp_path / "a.json", "mphdrr")
    systems = [mph.read_geometry(tmp_path / "a.json")[0]]
    run = mph.project_run(scanner, mph.Volume(np.ones((4, 4, 4)), mph.Grid.centered(4, 20.0), "activity"), (4, 5))
    for name in ("run.h5", "run.npz"):
        mph.write_run(run, tmp_path / name)
        systems.append(mph.read_run(tmp_path / name).system)
    for back in systems:
        assert getattr(back, column.field).tolist() == list(values)
        np.testing.assert_array_equal(back.tilt, scanner.tilt)
        np.testing.assert_array_equal(back.frames(), scanner.frames())


def test_what_a_column_cannot_hold_is_refused(system):
    for name, value, words in (
        ("crystal_material", [1] * 12, "expected texts"),
        ("crystal_material", ["NaI"] * 3, "expected one text, or one for each of 12 modules, got 3"),
        ("tilt", np.zeros((3, 3)), "expected shape 12 x 3, got 3 x 3"),
        ("tilt", [0, np.nan, 0], "nan is not a finite number"),
        ("weight", 3.0, "is no column of a pinhole scanner"),
    ):
        refused(lambda changes={name: value}: system.replace(**changes), f"{name}: {words}")


@pytest.mark.parametrize("largest", [1e-6, 0.05, 3.0])
def test_a_tilt_turns_a_module_about_its_nominal_axes(largest, system, rng):
    aimed = system.replace(tilt=0.0)
    tilt = rng.uniform(-1, 1, (12, 3)) * largest / np.sqrt(3)
    tilted = system.replace(tilt=tilt)
    for nominal, axes, axis_angle in zip(aimed.frames(), tilted.frames(), tilt, strict=True):
        axis = axis_angle @ nominal
        np.testing.assert_allclose(axes, nominal @ rodrigues(np.linalg.norm(axis), axis).T, atol=1e-14)
    np.testing.assert_allclose(aimed.at_poses(tilted.poses()).tilt, tilt, atol=1e-14)
    for settings in ({}, {"shape": (5, 8), "detector": "real", "pitch": (2.0, 3.0), "offset": (4.0, 6.0)}):
        views, straight = tilted.views(**settings), aimed.views(**settings)
        for m in range(12):
            _, targets = views.rays(m)
            local = (straight.rays(m)[1] - aimed.centers[m]) @ aimed.frames()[m].T
            np.testing.assert_allclose(targets, aimed.centers[m] + local @ tilted.frames()[m], atol=1e-9)


def test_without_a_tilt_every_digit_is_as_it_was(scanner):
    assert not scanner.tilt.any()
    np.testing.assert_array_equal(scanner.frames(), scanner.replace(tilt=np.zeros((80, 3))).frames())
    np.testing.assert_array_equal(scanner.frames()[:, 2], -scanner.centers / scanner.pinhole_distance[:, None])
    np.testing.assert_array_equal(scanner.isocentres(), scanner.pinhole_distance[:, None] * [0, 0, 1])


def test_a_point_on_a_tilted_axis_is_in_the_middle_of_its_image(system):
    for m in range(12):
        grid = mph.Grid.centered(1, 0.5, system.centers[m] + 200.0 * system.principal_rays[m])
        image = mph.Projector(grid, system[m : m + 1].views((31, 31)))(np.ones((1, 1, 1)))[0]
        assert np.unravel_index(image.argmax(), image.shape) == (15, 15)


def test_the_sphere_that_a_tilted_module_sees_is_the_largest(system, rng):
    """By points of the sphere: each meets the crystal through the whole hole, and of a larger one not all do."""
    directions = rng.normal(size=(50_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = system.roi_radius_seen()
    slopes = (system.detector_side - system.pinhole_diameter) / (2 * system.collimator_length)
    for m, radius in enumerate(radii):
        for size, inside in ((0.999 * radius, True), (1.02 * radius, False)):
            local = (size * directions - system.centers[m]) @ system.frames()[m].T
            reach = local[:, 2] * slopes[m] - system.pinhole_diameter[m] / 2
            assert np.all(np.abs(local[:, :2]).max(axis=1) <= reach) == inside


def test_a_tilted_modules_unseen_share_is_that_of_points(system, rng):
    small = system.replace(detector_side=system.detector_side - 10)
    report = mph.check_geometry(small)
    assert len(report.uncovered) == 12
    points = rng.normal(size=(400_000, 3))
    points *= rng.uniform(0, 1, (len(points), 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
    for m, finding in enumerate(report.uncovered):
        local = (small.roi_radius[m] * points - small.centers[m]) @ small.frames()[m].T
        slope = (small.detector_side[m] - small.pinhole_diameter[m]) / (2 * small.collimator_length[m])
        outside = np.abs(local[:, :2]).max(axis=1) > local[:, 2] * slope - small.pinhole_diameter[m] / 2
        assert finding.unseen_share == pytest.approx(outside.mean(), abs=4e-3)


def test_modules_have_the_crystals_that_they_say(system):
    """A module's own material counts as if all had it, whatever the others have."""
    named = np.array(["NaI", "CZT", ""] * 4)
    mixed = mph.Emission(system.replace(crystal_material=named), isotope="I-123", crystal_mu="BGO")
    unnamed = system.replace(crystal_material="")
    for m in range(12):
        alone = mph.Emission(unnamed[m], isotope="I-123", crystal_mu=named[m] or "BGO")
        assert mixed.crystal_mu[m] == pytest.approx(alone.crystal_mu, rel=1e-12)
    part = mixed.of_views(np.array([1, 3]))
    np.testing.assert_array_equal(part.crystal_mu, mixed.crystal_mu[[1, 3]])
    for materials, words in (
        (named, ("module 103 has no crystal material, others have: ", "crystal_mu for the rest")),
        ("glass", ("material 'glass': expected one of",)),
    ):
        wrong = system.replace(crystal_material=materials)
        refused(lambda wrong=wrong: mph.Emission(wrong, isotope="I-123"), *words)
    with pytest.warns(mph.InputWarning, match="without an isotope their photons have no energy"):
        assert mph.Emission(system.replace(crystal_material="NaI")).crystal_mu is None
