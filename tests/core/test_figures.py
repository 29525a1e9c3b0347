"""Figures that need no Blender: what they say is true, as pixels and as text, at every size."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

import mphdrr.core as mph
from mphdrr.addon.cli import main
from mphdrr.addon.cli.scene import INSTALL_BLENDER
from mphdrr.core.figures.kinds import KINDS
from mphdrr.core.figures.page import Page
from mphdrr.core.figures.subject import FigureSubject
from mphdrr.core.figures.sums import orthogonal_sum
from mphdrr.core.runs import letters
from mphdrr.core.runs.display import resize_picture

from .conftest import FEWER_MODULES, dc_spect, refused, run_python

TEXT = re.compile(
    r'<text x="([\d.-]+)" y="([\d.-]+)" font-size="([\d.]+)" fill="[^"]+" text-anchor="(\w+)"( transform="[^"]+")?>([^<]*)<'
)
DRAWN = [kind for kind in KINDS.values() if kind.draw is not None]


@pytest.fixture(scope="module")
def subject() -> FigureSubject:
    system = dc_spect()[::5]
    pose = mph.euler_pose(np.radians(30), np.radians(55), np.radians(-10), (10.0, 0.0, -5.5))
    volume = mph.DerenzoPhantom(40, (8, 6, 5, 4, 3, 2), 40, 100).voxelize(mph.Grid.centered(40, 2.6), pose)
    views = system.views(shape=(16, 24))
    run = mph.ProjectionRun(mph.Projector(volume.grid, views)(volume), system, views, volume)
    return FigureSubject(scanner=system, volume=volume, run=run, pose=pose, name="Derenzo <&>")


def draw(name: str, subject: FigureSubject, size: tuple[int, int] | None = None) -> Page:
    page = Page(*(size or KINDS[name].size))
    KINDS[name].draw(page, subject)
    return page


def texts(page: Page, folder: Path) -> list[str]:
    page.write(folder / "figure.svg")
    return [match[5] for match in TEXT.findall((folder / "figure.svg").read_text(encoding="utf-8"))]


def test_sums_along_the_axes_are_the_arrays_sums():
    array = np.random.default_rng(1).random((5, 6, 7), np.float32)
    volume = mph.Volume(array, mph.Grid.centered((5, 6, 7), 2.5, (3.0, -4.0, 11.0)))
    for axis in range(3):
        values, box = orthogonal_sum(volume, axis)
        np.testing.assert_allclose(values, array.sum(axis=axis) * 2.5, rtol=1e-5)
        np.testing.assert_allclose(box, [[-3.25, -11.5, 2.25], [9.25, 3.5, 19.75]])


def test_sums_of_a_turned_volume_keep_its_total():
    pose = mph.euler_pose(0.4, 0.9, 0.2, (5.0, 0.0, 0.0))
    grid = mph.Grid((24, 30, 40), pose @ mph.Grid.centered((24, 30, 40), (2.0, 2.0, 1.5)).affine)
    volume = mph.Volume(np.random.default_rng(2).random(grid.shape, np.float32), grid)
    total = float(volume.array.sum(dtype=float)) * grid.voxel_volume
    for axis in range(3):
        values, box = orthogonal_sum(volume, axis)
        area = np.prod(np.delete(box[1] - box[0], axis)) / values.size
        assert values.sum(dtype=float) * area == pytest.approx(total, rel=5e-3)


def test_sums_print_translation_and_rotation(subject, tmp_path):
    largest = max(float(orthogonal_sum(subject.volume, axis)[0].max()) for axis in range(3))
    assert {
        "Orthogonal sums: Derenzo &lt;&amp;&gt;", "T = (10, 0, −5.5) mm    R = (φ, θ, ψ) = (30, 55, −10)°",
        "40 × 40 × 40 voxels of 2.6 × 2.6 × 2.6 mm", f"{largest // 1000 * 1000:g}", "kBq/mL · mm",
        *(f"Sum along {x}" for x in "xyz"),
    } <= set(texts(draw("sums", subject), tmp_path))  # fmt: skip
    ct = FigureSubject(volume=mph.Volume(np.zeros((4, 4, 4)), mph.Grid.centered(4, 1.0), "hu"))
    refused(lambda: draw("sums", ct), "orthogonal sums: expected a volume of activity or mu, got hu")


def test_mosaics_show_the_images_with_their_numbers(subject, tmp_path):
    run = subject.run
    wide, fov = draw("mosaic-wide", subject, (900, 700)), draw("mosaic", subject, (900, 700))
    for page, part in ((wide, "16 × 24"), (fov, "8 × 12")):
        said = texts(page, tmp_path)
        assert any(text.endswith(f"{part} pixels") for text in said)
        assert {str(number) for number in run.system.numbers} <= set(said)
    for page, images in ((wide, run.projections), (fov, run.projections[:, 4:-4, 6:-6])):
        assert f"{images.max() // 1000 * 1000:g}" in texts(page, tmp_path), "a round number on the colour bar"
    only = draw("mosaic", FigureSubject(run=run, modules="1-6"), (900, 700))
    assert "6" in texts(only, tmp_path) and "11" not in texts(only, tmp_path)


@pytest.mark.parametrize("number", [1, 76])
def test_the_virtual_c_arm_prints_the_modules_distances(subject, tmp_path, number):
    system = subject.scanner[subject.scanner.numbers == number]
    page = draw("c-arm", FigureSubject(scanner=subject.scanner, modules=str(number)))
    b, l = float(system.pinhole_distance[0]), float(system.collimator_length[0])
    off = float(np.linalg.norm(mph.c_arm_views(system).sources[0] - system.centers[0]))
    where = "behind" if 5 * l > b else "in front of"
    assert {
        f"l = {l:.4g} mm", f"b = {b:.4g} mm", f"10 l = {10 * l:.4g} mm", f"5 l = {5 * l:.4g} mm",
        f"source {off:.4g} mm {where} the pinhole", f"Field at the isocentre: {50 * b / l:.4g} mm",
    } <= set(texts(page, tmp_path))  # fmt: skip


@pytest.mark.parametrize("size", [(240, 240), (500, 1500)])
@pytest.mark.parametrize("kind", DRAWN, ids=lambda kind: kind.name)
def test_nothing_is_cut_off_at_any_size(subject, tmp_path, kind, size):
    page = draw(kind.name, subject, size)
    for ending in ("png", "svg"):
        page.write(tmp_path / f"figure.{ending}")
    assert Image.open(tmp_path / "figure.png").size == size
    if min(size) < 300:
        return
    picture = page.picture
    assert min(edge.min() for edge in (picture[0], picture[-1], picture[:, 0], picture[:, -1])) == 255
    for x, y, em, anchor, turn, text in TEXT.findall((tmp_path / "figure.svg").read_text(encoding="utf-8")):
        wide = letters.width(text, float(em))
        start = (float(y) + wide / 2) if turn else float(x) - {"start": 0, "middle": 0.5, "end": 1}[anchor] * wide
        assert start > -1 and (start if turn else start + wide) < (size[1] if turn else size[0]) + 1, text
        assert 0 < float(y) < size[1], text


def test_pixels_and_svg_show_the_same_drawing(tmp_path):
    page = Page(300, 240, "#ffffff")
    page.area([(20, 20), (120, 20), (120, 80), (20, 80)], "#ff0000", 0.5)
    page.line([(10, 120), (290, 120)], "#000000", 4.0)
    page.text("1 < 2 & µ", 20, 200, 20, "#0000ff")
    page.area([(-50, -50), (10, -50), (10, 10), (-50, 10)], "#00ff00")  # partly off the page
    picture = page.picture
    assert picture[50, 70].tolist() == [255, 128, 128] and picture[2, 2].tolist() == [0, 255, 0]
    assert (picture[118:122, 100] == 0).all() and picture[125, 100].tolist() == [255, 255, 255]
    assert 60 < (picture[180:206, 20:120, 0] < 128).sum() < 600
    page.write(tmp_path / "figure.svg")
    root = ElementTree.parse(tmp_path / "figure.svg").getroot()
    assert [mark.tag.split("}")[1] for mark in root] == ["rect", "polygon", "polyline", "text", "polygon"]
    assert root[3].text == "1 < 2 & µ"
    refused(lambda: page.write(tmp_path / "figure.pdf"), "expected a name ending in .png, .svg")


def test_resizing_keeps_means():
    picture = np.random.default_rng(3).random((31, 47, 2))
    for shape in ((7, 10), (31, 47), (62, 94), (100, 33)):
        means = resize_picture(picture, *shape).mean(axis=(0, 1))
        np.testing.assert_allclose(means, picture.mean(axis=(0, 1)), rtol=1e-5)
    np.testing.assert_allclose(resize_picture(picture, 62, 94)[::2, 1::2], picture, rtol=1e-5)


def figure(*words: object) -> int:
    return main(["figure", *map(str, words)])


def test_the_command_lists_and_draws_phantoms_runs_and_volumes(subject, tmp_path, capsys):
    assert figure("--list") == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(KINDS)
    out, pose = tmp_path / "sums.svg", ("--euler-degrees", 30, 55, 0, "--position", 5, 0, 0)
    assert figure("sums", "derenzo", "--voxels", 24, *pose, "-o", out) == 0
    assert "T = (5, 0, 0) mm    R = (φ, θ, ψ) = (30, 55, 0)°" in out.read_text(encoding="utf-8")
    assert capsys.readouterr().out == f"{out}\n"
    mph.write_run(subject.run, tmp_path / "run.npz")
    mph.write_volume(subject.volume, tmp_path / "volume.npz")
    size = ("--size", "400x300")
    for kind in ("mosaic", "mosaic-wide", "sums", "c-arm"):
        assert figure(kind, tmp_path / "run.npz", *size, "-o", tmp_path / f"{kind}.png") == 0
        assert Image.open(tmp_path / f"{kind}.png").size == (400, 300)
    assert figure("sums", tmp_path / "volume.npz", *size, "-o", tmp_path / "sums.svg") == 0
    assert "Grid's centre (0, 0, 0) mm" in (tmp_path / "sums.svg").read_text(encoding="utf-8").replace("&#x27;", "'")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-o", "a.png"], "name a kind"),
        (["nothing", "-o", "a.png"], "figure 'nothing': expected one of scanner, cut-away"),
        (["sums", "derenzo"], "nothing to write: give --output FILE"),
        (["sums", "derenzo", "-o", "a.jpg"], "a.jpg: expected a name ending in .png, .svg"),
        (["sums", "derenzo", "-o", "a.png", "--size", "10x900"], "size 10x900: expected 120 to 16384 pixels"),
        (["sums", FEWER_MODULES, "-o", "a.png"], "figure sums: needs a volume: give a volume file, a phantom"),
        (["mosaic", FEWER_MODULES, "-o", "a.png"], "figure mosaic: needs projections"),
        (["c-arm", FEWER_MODULES, "--modules", "90", "-o", "a.png"], "--modules '90': no module 90; there are 1 to 24"),
        (["c-arm", FEWER_MODULES, "--position", "1", "2", "3", "-o", "a.png"], "--position is for a phantom"),
        (["scanner", "a.blend", FEWER_MODULES, "-o", "a.png"], "a.blend: a .blend holds all that is shown"),
    ],
)  # fmt: skip
def test_the_command_refuses_in_one_line(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    assert figure(*words) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and message in said
    assert not list(tmp_path.iterdir())


def test_figures_that_are_drawn_need_no_blender(tmp_path):
    run = run_python(
        "import sys; sys.modules['bpy'] = None; from mphdrr.addon.cli import main; "
        f"out = {str(tmp_path / 'a.png')!r}; book = {str(FEWER_MODULES)!r}; "
        "sys.exit(10 * main(['figure', 'c-arm', book, '-o', out]) + main(['figure', 'scanner', book, '-o', out]))"
    )
    assert run.returncode == 1, run.stderr
    assert f"this command needs Blender: {INSTALL_BLENDER}" in run.stderr
    assert (tmp_path / "a.png").is_file()
