"""``mphdrr geometry epipolar`` as a user types it."""

import json

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main

from .conftest import FEWER_MODULES

POINT = [8.0, -13, 21]


@pytest.fixture(scope="module")
def scanner() -> mph.PinholeSystem:
    return mph.read_system(FEWER_MODULES)


@pytest.fixture
def run(capsys):
    def of(*words, book=FEWER_MODULES, status=0):
        assert main(["geometry", "epipolar", str(book), *map(str, words)]) == status
        out, err = capsys.readouterr()
        errors = [line for line in err.splitlines() if not line.startswith("mphdrr: warning: three.xlsx")]
        assert len(errors) == status
        return json.loads(out) if "--json" in words else out or errors[0]

    return of


@pytest.fixture
def pixels(scanner):
    """Return the point's pixels in all modules."""
    return mph.project_points(scanner.views(), [POINT])[:, 0]


def pixel_options(scanner, pixels, *indices):
    return [x for m in indices for x in ("--pixel", f"{scanner.numbers[m]}:{pixels[m, 0]:.9f},{pixels[m, 1]:.9f}")]


def test_a_ray_is_where_python_says(run, scanner):
    views = scanner.views((128, 100), magnification=5.0)
    answer = run("--pixel", f"{scanner.numbers[6]}:60.5,70", "--json", "--size", 128, 100, "--magnification", 5)
    distance, radius = scanner.pinhole_distance[6], scanner.roi_radius[6]
    assert answer["module"] == scanner.numbers[6] and answer["pixel"] == [60.5, 70]
    np.testing.assert_allclose(answer["depths"], [distance - radius, distance + radius])
    np.testing.assert_allclose(answer["points"], mph.points_at_depths(views, 6, [60.5, 70], answer["depths"]))
    segments = mph.epipolar_segments(views, 6, [60.5, 70], *answer["depths"])
    assert [row["number"] for row in answer["modules"]] == scanner.numbers.tolist()
    for n, row in enumerate(answer["modules"]):
        if np.isnan(segments[n]).any():
            assert row["from"] is None and row["to"] is None
        else:
            np.testing.assert_allclose([row["from"], row["to"]], segments[n])
        if n == 6:
            assert row["line"] is None and row["epipole"] is None
            continue
        np.testing.assert_allclose(row["line"], mph.epipolar_lines(views, 6, n, [60.5, 70]))
        *place, depth = mph.epipole(views, 6, n)
        pixel = np.array(place) / depth
        inside = depth > 0 and (pixel > -0.5).all() and (pixel < [99.5, 127.5]).all()
        assert row["epipole"] == (pytest.approx(pixel.tolist()) if inside else None)


def test_its_table_lists_the_modules_asked_for(run, scanner):
    lines = run("--pixel", "7:120,130", "--modules", "1-5,7").splitlines()
    assert "module 7, pixel (120, 130) from a depth of" in lines[0] and "from column, row" in lines[1]
    assert [int(line.split()[0]) for line in lines[2:8]] == [1, 2, 3, 4, 5, 7]
    assert lines[7].count("120.00, 130.00") == 2 and lines[8].startswith("6 of 6 modules")
    one = run("--pixel", "7:120,130", "--modules", "7-8", "--depth", 200)
    place = mph.points_at_depths(scanner.views(), 6, [120, 130], 200.0)
    assert " ".join(f"{x:.2f}" for x in place) in one and one.count("120.00, 130.00") == 1


def test_an_epipole_in_the_image_is_listed(run, tmp_path):
    """Two modules that face each other, and one across."""
    system = mph.PinholeSystem([[0, 200, 0], [3, -220, 5], [210, 0, 0]], *np.outer([2, 60, 90, 5, 75], np.ones(3)))
    mph.write_system(system, tmp_path / "three.xlsx")
    lines = run("--pixel", "1:100,90", book=tmp_path / "three.xlsx").splitlines()
    u, v, depth = mph.epipole(system.views(), 0, 1)
    assert f"{u / depth:.2f}, {v / depth:.2f}" in lines[3] and lines[2].endswith("-") and lines[4].endswith("-")


def test_a_point_is_found_from_its_pixels(run, scanner, pixels):
    modules = [3, 11, 21]
    text = run(*pixel_options(scanner, pixels, *modules))
    assert text.startswith("point x 8.000 +- ") and text.rstrip().endswith("they fit together")
    answer = run(*pixel_options(scanner, pixels, *modules), "--sigma", 0.5, "--json")
    np.testing.assert_allclose(answer["point"], POINT, atol=1e-6)
    fit = mph.fit_marker(scanner.views(), modules, pixels[modules], 0.5)
    for name in ("covariance", "standard_deviations"):
        np.testing.assert_allclose(answer[name], getattr(fit, name), rtol=1e-6)
    assert answer["misfitting"] is None and answer["degrees"] == 3 and answer["sigma"] == 0.5
    assert [row["number"] for row in answer["modules"]] == scanner.numbers[modules].tolist()


def test_the_module_that_does_not_fit_is_named(run, scanner, pixels):
    pixels[8] += [5, 4]
    words = pixel_options(scanner, pixels, 3, 19, 8, 13, 22)
    assert f"module {scanner.numbers[8]} does not fit" in run(*words)
    answer = run(*words, "--json")
    assert answer["misfitting"] == scanner.numbers[8]
    assert max(answer["modules"], key=lambda row: row["misfit"])["number"] == scanner.numbers[8]
    two = run(*pixel_options(scanner, pixels, 8, 13), "--sigma", 0.1)
    assert "nothing says which is wrong" in two and two.count(" -\n") == 2
    assert run(*pixel_options(scanner, pixels, 8, 13), "--json")["modules"][0]["misfit"] is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--pixel 7:3", "MODULE:COLUMN,ROW"),
        ("--pixel 7,3,4", "MODULE:COLUMN,ROW"),
        ("--pixel 99:3,4", "no module 99; there are 1 to 24"),
        ("--pixel 7:nan,4", "--pixel '7:nan,4': expected"),
        ("--pixel 7:3,4 --pixel 7:3,5", "several of module 7"),
        ("--pixel 7:3,4 --pixel 8:3,5 --sigma 0", "sigma"),
        ("--pixel 7:3,4 --pixel 8:3,5 --depth 9", "--depth"),
        ("--pixel 7:3,4 --pixel 8:3,5 --modules 9", "--modules"),
        ("--pixel 7:3,4 --sigma 2", "--sigma"),
        ("--pixel 7:3,4 --depth 3 2", "--depth: expected one depth of 0 mm or more, or two in ascending order, got 3"),
        ("--pixel 7:3,4 --depth 200 inf", "--depth: expected"),
        ("--pixel 7:3,4 --depth nan", "--depth: expected"),
        ("--pixel 7:3,4 --depth 1 2 3", "one depth or two"),
    ],
)
def test_what_cannot_be_answered_is_refused(run, words, said):
    assert said in run(*words.split(), status=1)
