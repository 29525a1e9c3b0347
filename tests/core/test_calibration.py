"""Calibration: images of points in closed form, and the scanner that they tell."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main

pytest.importorskip("scipy", reason="no scipy")

from mphdrr.core.design import calibration_recipe
from mphdrr.core.design.bundle import BundleAdjustment
from mphdrr.core.geometry.frames import affine_matrix

from .conftest import refused

SHAPE = (48, 48)
PHYSICS = {"intrinsic_fwhm": 2.0}


def points_of(n, seed=1, size=38.0):
    """Return a point in the middle and corners of a cube, a little off; the first 4 corners make a tetrahedron."""
    corners = size * np.array(
        [[0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, -1], [-1, -1, -1], [1, -1, 1]]
    )
    return corners[:n] + np.random.default_rng(seed).normal(0, 3, (n, 3))


class Measured:
    """Scanner off by 1 mm and 0.5 degrees, and its counts of points."""

    def __init__(self, nominal, n=8, counts=20_000, seed=2, **changes):
        rng = np.random.default_rng(seed)
        m = len(nominal)
        off = {
            "centers": nominal.centers + rng.normal(0, 1, (m, 3)),
            "tilt": nominal.tilt + np.radians(rng.normal(0, 0.5, (m, 3))),
        }
        self.nominal, self.true, self.points = nominal, nominal.replace(**off, **changes), points_of(n)
        self.views = nominal.views(SHAPE)
        self.true_views = self.true.views(SHAPE)
        self.counts, self.rng = counts, rng

    def images(self):
        expected = mph.point_images(mph.Emission(self.true, **PHYSICS), self.true_views, self.points)
        return self.rng.poisson(expected * self.counts / expected.sum((2, 3), keepdims=True))

    def calibrated(self, images=None, **options):
        images = self.images() if images is None else images
        return mph.calibrate(self.nominal, images, self.views, model=mph.Emission(self.nominal, **PHYSICS), **options)

    def errors(self, found):
        """Return the errors (M, 6) that the covariance is of, after the true scanner was moved as a whole by the gauge."""
        true, used = self.true, found.used.any(axis=0)
        if found.gauge:
            middle, goal = (system.centers[used].mean(axis=0) for system in (true, self.nominal))
            apart, wanted = true.centers - middle, self.nominal.centers[used] - goal
            u, _, vt = np.linalg.svd(wanted.T @ apart[used])
            turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
            turned = apart @ turn.T
            scale = (wanted**2).sum() / (wanted * turned[used]).sum() if "scale" in found.gauge else 1.0
            true = true.at_poses(affine_matrix((true.frames() @ turn.T).swapaxes(1, 2), goal + scale * turned))
        shifts = np.einsum("mij,mj->mi", found.system.frames(), found.system.centers - true.centers)
        return np.concatenate([shifts, found.system.tilt - true.tilt], axis=1)

    def normalized(self, found):
        """Return the errors' sum of squares per degree of freedom (M,)."""
        errors = self.errors(found)
        return np.einsum("mi,mij,mj->m", errors, np.linalg.inv(found.covariance), errors) / 6


@pytest.fixture
def some(scanner):
    """Return ten modules of the four rings."""
    return scanner[::8]


@pytest.mark.parametrize("detector", ["virtual", "real"])
@pytest.mark.parametrize(
    "physics", [{}, {"intrinsic_fwhm": 2.0, "crystal_mu": "NaI", "isotope": "Tc-99m", "aperture_mu": "tungsten"}]
)
def test_images_of_points_are_those_of_tiny_voxels(scanner, detector, physics):
    system, point, side = scanner[:40:13], np.array([20.0, -15, 30]), 0.05
    model, views = mph.Emission(system, **physics, hole="depth"), system.views((64, 64), detector)
    image = mph.point_images(model, views, [point], activity=100.0)[0]
    activity = np.zeros((3, 3, 3), np.float32)
    activity[1, 1, 1] = 100 / (side**3 / 1000)
    projected = mph.Projector(mph.Grid.centered((3, 3, 3), side, point), views, model)(activity)
    total = projected.sum((1, 2))
    assert np.allclose(image.sum((1, 2)), total, rtol=2e-4)
    assert (np.abs(image - projected).sum((1, 2)) < 0.005 * total).all()
    if not physics:
        assert np.allclose(image.sum((1, 2)), 1e5 * mph.sensitivity(system, [point])[0])


def test_the_jacobian_is_that_of_central_differences(some, rng):
    m, pairs = len(some), np.array([[0, 1], [2, 3]])
    system = some.replace(tilt=rng.normal(0, 0.02, (m, 3)))
    sd = np.array([5.0] * 3 + [0.03] * 3 + [1.0, 0.5, 0.5])
    seen = rng.normal(0, 5, (5, m, 2)), np.broadcast_to(np.eye(2), (5, m, 2, 2)), rng.uniform(size=(5, m)) < 0.8
    fit, distances = ("collimator_length", "detector_offset"), np.array([30.0, 40])
    bundle = BundleAdjustment(system, points_of(5), True, fit, sd, *seen, pairs, distances, 0.1)
    for each in (
        bundle,
        replace(bundle, fit=(), sd=sd[:6]),
        replace(bundle, fits_points=False, pairs=pairs[:0], distances=np.zeros(0)),
    ):
        x = rng.normal(0, 1, len(each.start()))
        numeric = np.array([(each.residuals(x + d) - each.residuals(x - d)) / 2e-6 for d in 1e-6 * np.eye(len(x))]).T
        assert np.abs(each.jacobian(x).toarray() - numeric).max() < 1e-7 * np.abs(numeric).max()


@pytest.mark.parametrize("known", ["nothing", "distances", "points"])
def test_the_scanner_is_found_within_the_stated_covariance(some, known):
    measured = Measured(some)
    table = np.linalg.norm(measured.points[:, None] - measured.points, axis=2)
    options = {"nothing": {}, "points": {"points": measured.points}, "distances": {"distances": table}}[known]
    founds = [measured.calibrated(**options) for _ in range(2)]
    assert 0.7 < np.mean([measured.normalized(found) for found in founds]) < 1.3
    found = founds[0]
    assert found.gauge == {"nothing": ("shift", "turn", "scale"), "distances": ("shift", "turn"), "points": ()}[known]
    assert found.misfitting == () and found.used.all() and found.untold() == []
    errors = np.sqrt((measured.errors(found) ** 2).mean(axis=0))
    assert (errors[:3] < 0.15).all() and (np.degrees(errors[3:]) < 0.03).all()
    assert found.chi_square.mean() == pytest.approx(1, abs=0.06)
    assert np.mean([each.misfit for each in founds]) == pytest.approx(1, abs=0.25)
    if known == "points":
        assert np.array_equal(found.points, measured.points)
    elif known == "distances":
        assert np.allclose(np.linalg.norm(found.points[:, None] - found.points, axis=2), table, atol=0.1)
    # Whatever the gauge is, both scanners see their points in the same pixels.
    seen = mph.project_points(found.views, found.points) - mph.project_points(measured.true_views, measured.points)
    assert np.sqrt((seen**2).mean()) < 0.03


def test_real_and_virtual_detectors_tell_the_same(some):
    measured = Measured(some, n=5)
    images = measured.images()
    found = measured.calibrated(images)
    measured.views = some.views(SHAPE, "real")
    real = measured.calibrated(images[..., ::-1, ::-1])
    assert np.allclose(found.system.centers, real.system.centers, atol=1e-5)
    assert np.allclose(found.chi_square, real.chi_square, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("fault", ["one image shifted", "another module's", "upside down", "a double spot"])
def test_a_module_with_wrong_images_is_named_and_spoils_no_other(some, fault):
    measured = Measured(some)
    images = measured.images()
    if fault == "one image shifted":
        images[3, 5] = np.roll(images[3, 5], 2, axis=1)
    elif fault == "another module's":
        images[:, 5] = images[:, 6]
    elif fault == "upside down":
        images[:, 5] = images[:, 5, ::-1]
    else:
        images[:, 5] += np.roll(images[:, 5], 3, axis=2)
    found = measured.calibrated(images)
    assert found.misfitting == (some.numbers[5],)
    others = np.arange(len(some)) != 5
    assert found.chi_square[5] > 1.2
    assert 0.6 < measured.normalized(found)[others].mean() < 1.5
    assert found.chi_square[others].mean() == pytest.approx(1, abs=0.08)


@pytest.mark.long
def test_a_wrong_module_takes_no_others_with_it_where_a_distance_is_known(scanner):
    """All 80: their scale hangs on the distance alone."""
    measured = Measured(scanner, seed=1)
    images = measured.images()
    images[:, 36] = images[:, 36, ::-1]
    distances = np.full((len(measured.points),) * 2, np.nan)
    distances[0, 1] = np.linalg.norm(measured.points[0] - measured.points[1])
    found = measured.calibrated(images, distances=distances)
    assert found.misfitting == (scanner.numbers[36],) and found.used.sum() == 79 * len(images)


def test_what_images_do_not_tell_stays_nominal(some):
    measured = Measured(some)
    images = measured.images()
    images[:, 5] = 0
    found = measured.calibrated(images, points=measured.points)
    assert not found.used[:, 5].any() and np.isnan(found.chi_square[5])
    assert np.allclose(found.system.centers[5], some.centers[5]) and np.allclose(found.system.tilt[5], some.tilt[5])
    assert np.allclose(found.told[5], 0) and (np.delete(found.told, 5, axis=0) > 0.9).all()
    names = "position u, position v, position k, tilt u, tilt v, tilt k"
    assert found.untold() == [f"module {some.numbers[5]}: {names}"]
    assert np.allclose(found.spread[5], [5.0] * 3 + [np.radians(2)] * 3, rtol=1e-3)


def test_lengths_and_offsets_are_found_too(some):
    lengths = some.collimator_length + np.random.default_rng(4).normal(0, 0.5, len(some))
    measured = Measured(some, counts=100_000, collimator_length=lengths)
    offsets = measured.rng.normal(0, 0.3, (len(some), 2))
    views, (u, v, _) = measured.true_views, measured.true.frames().swapaxes(0, 1)
    centers = views.detector_centers - 10 * (offsets[:, :1] * u + offsets[:, 1:] * v)  # point-inverted, 10 times as far
    measured.true_views = mph.Views(views.sources, centers, views.u_steps, views.v_steps, SHAPE)
    found = measured.calibrated(points=measured.points, fit=("collimator_length", "detector_offset"))
    assert found.names[6:] == ("length", "offset u", "offset v")
    assert 0.6 < measured.normalized(found).mean() < 1.4
    off = np.concatenate([(found.system.collimator_length - lengths)[:, None], found.detector_offset - offsets], axis=1)
    assert 0.6 < np.sqrt(((off / found.spread[:, 6:]) ** 2).mean()) < 1.4
    seen = mph.project_points(found.views, measured.points) - mph.project_points(measured.true_views, measured.points)
    assert np.sqrt((seen**2).mean()) < 0.02


def test_known_points_calibrate_a_module_alone(some):
    measured = Measured(some[:1])
    found = measured.calibrated(points=measured.points)
    assert found.gauge == () and measured.normalized(found)[0] < 3


def test_counts_of_a_background_do_not_move_spots(some):
    measured = Measured(some)
    images = measured.images() + measured.rng.poisson(2.0, (8, len(some), *SHAPE))
    found = measured.calibrated(images)  # of which the model knows nothing
    assert found.misfitting == () and 0.6 < measured.normalized(found).mean() < 1.4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": np.ones((2, 10, *SHAPE))}, "expected 3 acquisitions or more"),
        ({"images": np.ones((4, 9, *SHAPE))}, "images: expected shape any x 10 x 48 x 48"),
        ({"images": np.zeros((4, 10, *SHAPE))}, "acquisition 1: 0 modules see a point source"),
        ({"images": -np.ones((4, 10, *SHAPE))}, "expected counts, 0 or more"),
        ({"points": np.zeros((3, 3))}, "points: expected shape 4 x 3"),
        ({"distances": np.zeros((3, 3))}, "distances: expected shape 4 x 4"),
        ({"distances": np.zeros((4, 4))}, "lengths above 0 mm"),
        ({"points": np.zeros((4, 3)), "distances": np.full((4, 4), 9.0)}, "points or distances, not both"),
        ({"fit": ("roll",)}, "expected one of collimator_length, detector_offset"),
        ({"tilt_sd_degrees": 0.0}, "expected more than 0"),
        ({"points": points_of(4) + 60.0}, "most modules would be farther"),
    ],
)
def test_one_line_says_what_is_wrong(some, changes, message):
    measured = Measured(some, n=4)
    options = {"images": measured.images(), **changes}
    with pytest.raises(mph.InputError, match=message) as caught:
        measured.calibrated(**options)
    assert "\n" not in str(caught.value)
    with pytest.raises(mph.InputError, match="expected that of the system"):
        mph.calibrate(some, np.ones((4, 10, *SHAPE)), measured.views, model=mph.Emission(some[::-1]))


@pytest.fixture
def recipe(workbook, scanner, tmp_path):
    """Write a recipe of five runs; return its path and the measurement."""
    some = scanner[::8]
    measured = Measured(some, n=5)
    model = mph.Recipe({"model.kind": "emission", "model.intrinsic_fwhm": 2.0})
    for k, counts in enumerate(measured.images()):
        crystals = counts[:, ::-1, ::-1]  # the images are upright
        run = mph.counts_run(crystals, some, some.numbers.tolist(), "back-v", 60.0, recipe=model)
        mph.write_run(run, tmp_path / f"point{k}.h5")
    pairs = [[1, 2, float(np.linalg.norm(measured.points[0] - measured.points[1]))]]
    files = json.dumps([f"point{k}.h5" for k in range(5)])
    path = tmp_path / "points.toml"
    path.write_text(
        f"[runs]\nfiles = {files}\n[sources]\ndistances = {json.dumps(pairs)}\n[priors]\nposition_sd = 4.0\n"
    )
    return path, measured


def test_the_command_writes_workbook_numbers_and_picture(recipe, tmp_path, capsys):
    path, _ = recipe
    assert main(["geometry", "calibrate", str(path), "-o", str(tmp_path / "found.xlsx"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said == json.loads((tmp_path / "found.json").read_text())
    assert said["gauge"] == ["shift", "turn"] and said["misfitting"] == []
    with pytest.warns(mph.InputWarning, match="the formula gives"):  # l is that of the nominal place
        written = mph.read_system(tmp_path / "found.xlsx")
    assert np.allclose(written.tilt, said["tilt"], atol=1e-9) and np.allclose(written.centers, said["centers"])
    assert np.array(said["covariance"]).shape == (10, 6, 6)
    assert (tmp_path / "found.png").read_bytes().startswith(b"\x89PNG")
    assert main(["geometry", "calibrate", str(path), "-o", str(tmp_path / "found.xlsx")]) == 0
    text = capsys.readouterr().out
    assert "10 modules by 5 points, 50 of 50 images" in text and "all modules fit" in text
    assert re.search(
        r"crystals' blur: FWHM 2\.0\d\d mm, known to 0\.00\d mm|FWHM 1\.9\d\d mm, known to 0\.00\d mm", text
    )
    assert np.allclose(said["blur"], 2, atol=0.05) and len(said["blur_sd"]) == 10


def test_a_recipe_says_the_source_and_the_physics(recipe, monkeypatch):
    path, _ = recipe
    calls = []
    monkeypatch.setattr(calibration_recipe, "calibrate", lambda *images, **options: calls.append(options))
    path.write_text(
        path.read_text().replace("[sources]", "[model]\ncrystal_mu = 0.4\ndepth_layers = 5\n[sources]\ndiameter = 2")
    )
    calibration_recipe.run_calibration(path)
    (options,) = calls
    model = options["model"]
    assert options["source_diameter"] == 2 and model.depth_layers == 5 and np.allclose(model.crystal_mu, 0.4)
    assert model.intrinsic_fwhm == 2 and model.system.detector_thickness[0] == 10


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({"counts": 24}, "24 x 24 pixels, but 48 x 48 pixels"),
        ({"detector": "virtual"}, "the virtual detector, but the real detector"),
        ({"magnification": 5.0}, "magnification 5, but magnification 10"),
        ({"pitch": 1.1}, "pixels of 1.1 x 1.1 mm, but pixels of "),
        ({}, "its pixels lie elsewhere than in point0.h5"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_a_run_with_other_views_is_refused_by_its_name(recipe, monkeypatch, changes, difference):
    path, measured = recipe
    monkeypatch.setattr(calibration_recipe, "calibrate", lambda *images, **options: None)
    calibration_recipe.run_calibration(path)
    some, name = measured.nominal, path.with_name("point3.h5")
    counts, model = np.ones((len(some), *[changes.get("counts", 48)] * 2), int), mph.read_run(name).recipe
    options = {"recipe": model} | {key: value for key, value in changes.items() if key != "counts"}
    run = mph.counts_run(counts, some, some.numbers.tolist(), "back-v", 60.0, **options)
    if not changes:
        run = replace(run, views=some.views((48, 48), "real", offset=(0.5, 0.0)))
    mph.write_run(run, name)
    refused(lambda: calibration_recipe.run_calibration(path), "points.toml: runs.files: point3.h5: " + difference)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "runs.files: missing; name a run file of each acquisition"),
        ("[runs]\nfiles = ['none.h5']", "none.h5: no such file"),
        ("[runs]\nfiles = []", "runs.files: expected 1 or more values"),
        ("[runs]\nfiles = ['point0.h5', 'point1.h5']", "expected 3 acquisitions or more"),
        ("[priors]\nposition = 3", "priors.position: no such setting"),
        ("[sources]\nplaces = 3", "sources.places: no such setting; expected points, distances, diameter"),
        ("[runs]\nfiles = ['point0.h5']\n[sources]\ndiameter = -1", "sources.diameter: expected 0 or more mm, got -1"),
        ("[runs]\nfiles = ['point0.h5']\n[model]\ndepths = 3", "model.depths: no such setting"),
        ("[runs]\nfiles = ['point0.h5']\n[sources]\ndistances = [[1, 7, 3.0]]", "sources from 1 to 1"),
        ("[fit]\ncollimator_length = 3", "fit.collimator_length: expected true or false"),
    ],
)
def test_one_line_says_what_is_wrong_in_a_recipe(recipe, tmp_path, capsys, text, message):
    path = recipe[0].with_name("wrong.toml")
    path.write_text(text)
    assert main(["geometry", "calibrate", str(path), "-o", str(tmp_path / "found.xlsx")]) == 1
    said = capsys.readouterr().err.strip()
    assert message in said and "\n" not in said
