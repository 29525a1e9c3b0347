"""What a user does in a real Blender's window, each by the steps of its script window_*.py, and what is then seen."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import numpy as np
import openpyxl
import pytest
from PIL import Image
from scipy import ndimage

from mphdrr.core.workbook import ColumnMap

ROOT = Path(__file__).resolve().parents[2]
WORKBOOK = ROOT / "examples" / "dc-spect-80.xlsx"
PAGE = ROOT / "docs" / "tutorial.md"


def pixels(path: Path) -> np.ndarray:
    """Return a picture as integers (rows, columns, 3)."""
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def test_main_path_runs_in_the_window(window, work_folder):
    result = window("main_path")
    assert {"run.npz", "scanner.blend", "scanner_mphdrr"} <= set(result["files"])

    # The rods are drawn, also after the first save has moved their .vdb.
    screen = pixels(result["screen"])
    x, y = result["phantom_at"]
    red, _, blue = screen[y - 30 : y + 30, x - 30 : x + 30].reshape(-1, 3).T
    assert np.mean((red > 110) & (red - blue > 40)) > 0.3, "in the mosaic's yellow"


def test_clicks_on_what_is_proposed_lead_to_a_score(window, work_folder):
    seen = window("beginner")
    assert seen["example"] == ["Load Example", "Reconstruct", "TRANSMISSION", "CGLS", "NRMSE", "Export Dataset"]
    done, found = seen["workbook"][:3], seen["workbook"][3:]
    assert done == ["Add Phantom", "Render Projections", "Reconstruct"]
    assert found == ["EMISSION", "OSEM", "NRMSE", "Export Dataset"], "what suits a phantom of activity"


def test_six_clicks_lead_from_an_empty_scene_over_a_ct_to_a_dose_map(window, work_folder):
    seen = window("xray")
    clicks = ["Load Example", "Reconstruct", "Use CT for SPECT", "Render Projections", "Reconstruct", "Dose Map"]
    assert seen["clicks"] == clicks
    assert [quantity for _, quantity in seen["volumes"]].count("dose_rate") == 1
    assert seen["tubes"].endswith("CT") and seen["next"] == "Export Dataset"


def close(one: dict, other: dict) -> None:
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert other[name] == pytest.approx(value, rel=1e-5), name


def consistent(state: dict) -> None:
    assert state["aimed"]
    assert state["crystal"] == pytest.approx(state["collimator_length"], rel=1e-6)
    assert state["lens"] == pytest.approx(state["collimator_length"] / 50.0, rel=1e-6)
    assert sum(x * x for x in state["place"]) ** 0.5 == pytest.approx(state["pinhole_distance"], rel=1e-6)


def test_a_look_dragged_from_the_asset_browser_restyles_a_phantom(window):
    seen = window("looks")
    assert seen["materials"] == ["Derenzo activity", "mphDRR Fire"]
    before, after = seen["brightest"]
    assert before[1] > before[0] and after[1] < after[0], "the slices go along: from inferno's last colour to fire's"
    assert seen["slice"] == ["Slice"] and seen["high"] == 100.0


def test_modules_follow_in_the_window(window, work_folder):
    seen = window("design")
    before = seen["before"]
    for name in ("before", "moved", "translated", "moving"):
        consistent(seen[name])
    assert seen["moved"]["place"] == pytest.approx([before["place"][0] + 30, *before["place"][1:]], abs=1e-4)
    assert seen["moving"]["place"][0] == pytest.approx(before["place"][0] + 40, abs=1e-4)
    assert seen["moved"]["sensitivity"] < 0.95 * before["sensitivity"] and seen["moved"]["total"] < before["total"]
    for name in ("undone", "translated_undone"):
        close(seen[name], before)
    close(seen["redone"], seen["moved"])

    everyone = list(range(1, 81))
    assert seen["copied"]["numbers"] == [*everyone, 81] and seen["copied"]["parts"] == 162
    consistent(seen["copied"]["state"])
    assert seen["adoption_undone"] == {"numbers": sorted([*everyone, 3]), "untidy": "1 copied camera"}
    assert seen["copy_undone"] == {"numbers": everyone, "parts": 160, "untidy": ""}
    assert seen["deleted"] == {"numbers": [n for n in everyone if n != 5], "parts": 158}
    assert seen["delete_undone"]["numbers"] == everyone and seen["delete_undone"]["parts"] == 160
    consistent(seen["delete_undone"]["state"])


def test_a_crystal_moves_its_module_and_the_panels_follow(window, work_folder):
    seen = window("scanners")
    before = seen["before"]
    for name, state in seen.items():
        if isinstance(state, dict):
            assert state["off"] < 1e-3, name
            assert abs(state["distance"]) < 1e-3 and state["aimed"] == (name != "turned"), name

    def moved(name: str) -> list[float]:
        return [x - x0 for x, x0 in zip(seen[name]["place"], before["place"], strict=True)]

    assert moved("moved") == pytest.approx([30, 0, 0], abs=1e-3) == moved("redone")
    assert moved("dragged") == pytest.approx([0, 20, 0], abs=1e-3)
    assert moved("scripted") == pytest.approx([0, 0, 25], abs=1e-3)
    assert moved("turned") == pytest.approx([0, 0, 0], abs=1e-3)
    x, y, z = moved("by_mouse")
    assert abs(x) + abs(y) < 1e-3 and abs(z) > 10 and moved("by_mouse_redone") == pytest.approx([x, y, z], abs=1e-3)
    for name in ("undone", "cancelled", "turned_back", "by_mouse_undone", "scripted_undone"):
        assert moved(name) == pytest.approx([0, 0, 0], abs=1e-3), name
        assert seen[name]["turned"] == pytest.approx(before["turned"], abs=1e-5), name

    assert seen["imported"]["panel"] == "B"
    assert (before["panel"], before["listed"], before["active"]) == ("A", 30, "Crystal 30")
    assert (seen["other"]["panel"], seen["other"]["listed"]) == ("B", 60)
    assert seen["back"]["panel"] == "B"
    whole, without, again = seen["counts"]
    assert again == whole
    gone = {kind: whole[kind] - without[kind] for kind in whole}
    assert gone == {"objects": 241, "meshes": 161, "cameras": 80, "materials": 0, "collections": 5}

    start, looking, undone, redone = seen["views"]
    assert undone == start != looking == redone, "the view of before the import comes back"
    assert seen["middle"] == pytest.approx([0.5, 0.5], abs=0.03), "framed beside the sidebar"
    assert moved("moving") == pytest.approx([0, 0, 0], abs=1e-3), "A stays where it is"


def test_a_refused_workbook_is_imported_by_its_columns(window, work_folder):
    book = openpyxl.load_workbook(WORKBOOK, data_only=True)
    sheet = book["Coordinates"]
    sheet.delete_cols(5, sheet.max_column)
    for column, axis in enumerate("xyz", start=2):
        sheet.cell(1, column, f"Position {axis} (Zentimeter)")
        sheet.cell(2, column).value = None
        for row in range(3, 83):
            sheet.cell(row, column).value /= 10
    path = work_folder / "zentimeter.xlsx"
    book.save(path)

    seen = window("columns", path)
    assert seen["opened"]["refusal"] and "x1" in seen["opened"]["doubts"]
    assert seen["asked_again"]["refusal"] and seen["asked_again"]["scanners"] == 0
    assert seen["settled"]["refusal"] == "" and '"277.002"' in seen["settled"]["preview"]
    units = {c.quantity: c.unit for table in ColumnMap.from_toml(seen["source"]).tables for c in table.columns}
    assert units == {"x1": "cm", "y1": "cm", "z1": "cm", "d": "mm", "R": "mm", "Ld": "mm", "Td": "mm"}
    assert seen["emptied"] and seen["kept"] and seen["moved_back"]


@pytest.mark.alone
def test_phantom_follows_its_slider_and_beats_in_the_window(window, work_folder):
    seen = window("phantom")
    before, rested = seen["before"], seen["rested"]
    assert seen["dragging"]["outdated"] and seen["dragging"]["file"] == before["file"]
    assert seen["seconds"][len(seen["seconds"]) // 2] < 0.1
    for name, length in (("before", 180), ("rested", 260), ("small", 220), ("undone", 180)):
        assert seen[name]["length"] == length and seen[name]["loads"] and not seen[name]["outdated"]
        assert len(seen[name]["planes"]) == 3
    assert rested["file"] != before["file"] and seen["undone"] == before
    assert seen["frames"] == [1, 2, 3]


def test_slices_shells_and_maps(window, work_folder):
    seen = window("volumes")
    left, top, right, bottom = seen["frame"]

    def picture(name: str) -> np.ndarray:
        """Return the middle of the 3D view, away from its buttons."""
        screen = pixels(work_folder / f"{name}.png")
        return screen[top + 60 : bottom - 20, left + 170 : right - 60]

    def colored(name: str, saturation: float = 0.15) -> tuple[np.ndarray, np.ndarray]:
        """Return a picture's hue in degrees, and where it has colours."""
        hsv = np.asarray(Image.fromarray(picture(name).astype(np.uint8)).convert("HSV")).astype(float)
        return hsv[..., 0] * 360 / 255, (hsv[..., 1] > 255 * saturation) & (hsv[..., 2] > 60)

    def parts(name: str, least: int = 20) -> int:
        """Return the number of yellow parts that fill their boxes, as the selected object's outline does not."""
        hue, where = colored(name)
        labels, n = ndimage.label(where & (hue > 20) & (hue < 75))
        boxes = ndimage.find_objects(labels)
        sizes = [(labels[box] == i + 1).sum() for i, box in zip(range(n), boxes, strict=True)]
        return sum(size > max(least, 0.2 * labels[box].size) for size, box in zip(sizes, boxes, strict=True))

    assert parts("slice") == 6, "a slice of NEMA shows six spheres"
    assert parts("shell") == 6 and parts("heart", 300) == 1
    before, after = seen["dragged"]
    assert after[:2] == before[:2] and 5 <= after[2] - before[2] <= 15, "the slice follows the mouse"
    assert seen["undone"] == [after[2], True, True], "undo brings back what was painted"
    hue, where = colored("map")
    counts = np.bincount(hue[where & (hue > 55) & (hue < 205)].astype(int), minlength=360)
    assert (counts >= 5).sum() >= 20, "a map in Solid view has at least 20 hues"
    screen = pixels(work_folder / "map.png")
    x, y, width, height = seen["bar"]
    bar = screen[round(y) : round(y + height), round(x + width / 2)]
    assert len(np.unique(bar, axis=0)) > 50 and bar[0].sum() > bar[-1].sum() + 200, "its colour bar, brighter upwards"


@pytest.mark.alone
def test_the_example_is_seen_and_tiles_planes_list_and_mosaic_show_one_module(window, work_folder):
    seen = window("display")
    assert seen["seconds"] < 15 and seen["hidden"][:3] == ["Camera", "Cube", "Light"], "and three lamps"
    assert len(seen["hidden"]) == 6 and all("studio" in name for name in seen["hidden"][3:])
    assert seen["clicked"] == [30, 30] and seen["selected"] == [55, 55] and seen["planes"] == 80
    screen = pixels(seen["screen"])

    def lit(tile) -> float:
        """Return the share of a tile's left edge that is white."""
        left, top, _, bottom = map(round, tile)
        return float((screen[top + 4 : bottom - 4, left - 2 : left + 3].min(axis=2).max(axis=1) > 200).mean())

    tiles = [
        screen[round(top) : round(bottom), round(left) : round(right)] for left, top, right, bottom in seen["tiles"]
    ]
    assert min((tile[15:].max(axis=2) > 90).mean() for tile in tiles) > 0.05, "every tile shows the phantom"
    assert lit(seen["tile"]) > 0.9 and lit(seen["other"]) < 0.3, "the active module's tile has a frame"


@pytest.mark.alone
def test_a_live_preview_follows_module_phantom_and_numbers(window, work_folder):
    seen = window("preview")
    assert seen["off"]["median"] < 0.2
    assert seen["on"]["median"] <= 25, seen
    assert seen["quick"] > 35 and seen["full"], "few pixels while it moves, all of them at rest"
    assert seen["largest"] > 0 and seen["differs"] < 2e-5 and seen["same place"]
    assert seen["typed"] == 60 and seen["unit"] == "counts" and seen["images"]
    assert "pinhole_diameter" in seen["impossible"] and seen["again"] == ""
    assert seen["dragged"] == [pytest.approx(-100, abs=3), pytest.approx(50, abs=3), True], "the box follows the mouse"
    assert seen["picked"] == [False, 0.0, True], "the eyedropper's click set the window's high end to an exact number"


@pytest.mark.alone
def test_the_marker_dragged_to_a_point_is_where_all_modules_see_it(window, work_folder):
    seen = window("epipolar")
    assert seen["picked"][:3] == [30, 37, 26], "the click's pixel"
    wanted, k, steps = seen["k"]
    assert abs(k / wanted - 1) < 0.01 and steps > 5 and seen["moved"] > 1, "the slider was dragged"
    off = [each for each in seen["off"] if each is not None]
    assert len(off) == seen["seen by"] > 60 and max(off) < 1, "pixels between the marker and the point's image"
    assert seen["on plane"] == seen["target"][0]
    assert seen["ms for each k"] < 20 and max(seen["ms to draw"]) < 50


def test_a_frustum_and_a_back_projection_are_seen(window, work_folder):
    seen = window("frustum")
    assert len(seen["shown"]) == 13 and seen["active"] == "Derenzo"
    corners = np.array(seen["corners"])
    assert violet(work_folder / "aside.png", corners.min(axis=0), corners.max(axis=0)) > 3000
    # From the pinhole, all layers lie on one another, in the frame of what the camera sees.
    layers, frame = np.array(seen["through"]).reshape(12, 4, 2), np.array(seen["frame"])
    assert np.abs(layers - layers[0]).max() <= 1
    assert np.abs(layers[0].min(axis=0) - frame.min(axis=0)).max() <= 2
    assert np.abs(layers[0].max(axis=0) - frame.max(axis=0)).max() <= 2
    assert violet(work_folder / "pinhole.png", frame.min(axis=0), frame.max(axis=0)) > 10000
    assert seen["kept"] == "Derenzo through Module 27"
    assert seen["backprojected"].endswith("Geometric Mean")
    x, y = seen["middle"]
    found = pixels(seen["screen"])[y - 80 : y + 80, x - 100 : x + 100]
    assert ((found[..., 1] > found[..., 0] + 30) & (found[..., 1] > 80)).sum() > 1000, "slices in greens"


def violet(picture: Path, low: np.ndarray, high: np.ndarray) -> int:
    """Return the number of pixels between two places that are violet to red, as dim activity is."""
    red, green, blue = np.moveaxis(pixels(picture)[low[1] : high[1], low[0] : high[0]], 2, 0)
    return int(((blue > green + 30) & (red > green + 30)).sum())


@pytest.mark.alone
def test_jobs_leave_the_window_alive_and_are_cancelled_without_a_trace(window, work_folder):
    seen = window("jobs")
    assert seen["changed"] == [] and seen["undone"] == 0.0
    assert seen["queue"] == [True, False, False] and seen["added"] == ["C"]
    assert seen["running"] == 1, "one job runs, one waits"
    assert seen["old_folder"][0] == seen["old_folder"][1] and all(seen["exists"])
    assert all(path.startswith("//new_mphdrr/") for path in seen["saved_meanwhile"])
    assert seen["disabled"] < 0.5, "s, while a job runs that does not look up"
    for words in (r"Voxelizing \d+ of \d+", r"Projecting \d+ of 80", r"Packing \d+ %", r".*\d s left"):
        assert any(re.fullmatch(words, text) for text in seen["words"]), words
    late = {name: pauses for name, pauses in seen["gaps"].items() if min(pauses) > 0.1}
    assert len(seen["gaps"]) == 5 and not late, f"longest pauses beyond that of a redraw, s: {late}"


def test_events_are_tried_made_and_opened(window, work_folder):
    seen = window("events")
    assert seen["note"] == ["derenzo, defrise; lines; Radon 32; 64³ voxels of 1.5 mm", False]
    assert seen["numbers"] == [1, 2, 3] and len(set(map(str, seen["poses"]))) == 3
    assert seen["undone"] == seen["poses"][1] and seen["number_undone"] == 2
    assert 0 < seen["after_cancel"] < 12 and seen["made"] == 12 and seen["kept"]
    assert any(text.startswith("Making events") and text.endswith(" left") for text in seen["words"]), seen["words"]
    assert min(seen["pauses"]) < 0.1, "the window stands still"
    opened, run = seen["opened"], seen["run"]
    assert opened.startswith("Event 3 ") and run.startswith("lines, ") and run.endswith(opened)
    assert seen["image"] == "mphDRR mosaic" and seen["changes"] == []


def test_measured_counts_are_imported_in_the_window(window, work_folder):
    seen = window("counts")
    assert seen["browsers"] == 1
    assert seen["runs"] == ["SPECT Counts, 32 × 32, counts.npy"] and seen["image"] == ["mphDRR mosaic"]
    assert seen["said"].startswith("counts.npy, 600 s, frames front+v.") and seen["changes"] == []


def test_a_reconstruction_is_seen_while_it_runs(window, work_folder):
    seen = window("reconstruction")
    first, second = seen["iterations"]
    assert 1 <= first < second < 20000
    assert seen["while"] == seen["volume"] == seen["active"] and seen["volume"].endswith("OSEM")
    assert seen["asked"] and seen["continued"] == 10, "Escape asks, and Continue goes on"
    assert seen["title"].startswith("OSEM, ") and seen["rods"][0] == "8 mm" and "Derenzo" in seen["hidden"]
    assert seen["image"] == "mphDRR reconstruction" and seen["size"] == seen["room"][:2], "it fills its editor"
    assert seen["zoom"] == pytest.approx([1.0, 1.0])
    screen = pixels(seen["screen"])
    left, top, width, height = seen["editor"]
    page = screen[top : top + height, left : left + width]
    assert (np.abs(page - (252, 255, 164)).max(axis=2) < 12).sum() > 50, "hot rods"
    assert (np.abs(page - (224, 96, 74)).max(axis=2) < 20).sum() > 10, "the objective"
    assert (page.max(axis=2) < 40).mean() > 0.5, "a dark page"


def test_stale_runs_are_said_and_compared_in_the_window(window, work_folder):
    seen = window("runs")
    moved = ["Module 30 moved"]
    said = [seen[when] for when in ("loaded", "moved", "undone", "moved again", "rendered", "chosen")]
    assert said == [[], moved, [], moved, [], moved]
    assert seen["handler ms"] < 0.1, "of each update of the scene, selecting included"
    assert seen["pictures"] == [None, *["mphDRR mosaic"] * 3], "undo and redo of the first run, and of the second"
    assert seen["shown"] == "As imported" and len(seen["runs"]) == 2
    assert seen["image"] == "mphDRR difference"
    screen = pixels(seen["screen"])
    left, top, width, height = seen["editor"]
    letters = np.abs(screen[top : top + height, left : left + width] - (255, 158, 51)).max(axis=2) < 12
    assert letters.sum() > 100, "a line below the picture says it, and the tile's corner, in this colour"


def test_scattered_photons_are_shown_apart_in_the_window(window, work_folder):
    seen = window("scatter")
    assert seen["shown"] == ["SCATTER"]
    assert seen["PRIMARY"] + seen["SCATTER"] == pytest.approx(seen["ALL"], rel=1e-4)
    assert 0.05 < seen["SCATTER"] / seen["ALL"] < 0.6
    pictures = [pixels(path) for path in sorted(work_folder.glob("*.png")) if path.stem in ("primary", "scatter")]
    assert len(pictures) == 2 and np.abs(np.subtract(*pictures, dtype=float)).max() > 50, "the mosaic has changed"


SIZE = "360x240"


def ssim(a: np.ndarray, b: np.ndarray, side: int = 8) -> float:
    """Return the mean SSIM of two grey pictures (0 to 255) over windows of side x side pixels (Wang et al. 2004)."""
    a, b = (np.lib.stride_tricks.sliding_window_view(np.asarray(p, float), (side, side)) for p in (a, b))
    mean_a, mean_b = a.mean(axis=(2, 3)), b.mean(axis=(2, 3))
    covariance = (a * b).mean(axis=(2, 3)) - mean_a * mean_b
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    likeness = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return float((likeness / ((mean_a**2 + mean_b**2 + c1) * (a.var(axis=(2, 3)) + b.var(axis=(2, 3)) + c2))).mean())


RENDER = """
import bpy, sys
bpy.ops.wm.open_mainfile(filepath=sys.argv[-2])
scene = bpy.context.scene
scene.render.engine, scene.cycles.samples = "CYCLES", 4
scene.render.resolution_x, scene.render.resolution_y, scene.render.filepath = 160, 120, sys.argv[-1]
scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(scene.camera)
scene.camera.location, scene.camera.data.clip_end = (0, 0, 400), 1000
bpy.ops.render.render(write_still=True)
"""


def test_window_and_command_draw_the_same_figures(blender, blender_script, window, work_folder):
    blend = work_folder / "scene.blend"
    seen = window("figure")
    assert seen["scenes"] == 1 and seen["display"] == ["WINDOW", "WINDOW"]
    assert seen["ticks"] > 3, "the window was alive while the figure was rendered"
    assert seen["film"] == 2 == len(list((work_folder / "film-frames").iterdir()))
    assert seen["asked"] and seen["shown"] == "picture.png"
    assert list((work_folder / "cut-frames").iterdir()) and not (work_folder / "cut.mp4").exists(), "cancelled"
    for kind in ("cut-away", "sums"):
        path = work_folder / f"{kind}-command.png"
        blender("--command", "mphdrr", "figure", kind, blend, "--size", SIZE, "--samples", "8", "-o", path)
        colors = pixels(path)  # where Cycles draws no volumes, as in Debian, the phantom is a surface
        assert kind != "cut-away" or np.count_nonzero(colors[..., 0] - colors[..., 1] > 40) > 100, "its colours"
        own, other = (np.asarray(Image.open(p).convert("L")) for p in (work_folder / f"{kind}.png", path))
        assert own.std() > 15, "something is to be seen"
        assert ssim(own, other) > 0.99
        assert ssim(own, np.roll(other, 3, axis=1)) < 0.95, "the measure tells pictures apart"
    done = blender_script(RENDER, blend, work_folder / "render.png")
    shown = pixels(work_folder / "render.png")
    is_drawn = np.count_nonzero(shown[..., 0] - shown[..., 1] > 40) > 100
    assert ("mphDRR: the picture shows nothing of" in done.stdout + done.stderr) != is_drawn
    assert ("mphDRR: the picture shows nothing of" in seen["said"]) != is_drawn, "the same in the window"


def test_the_rendered_view_shows_the_scanner(window, work_folder):
    seen = window("rendered")
    left, top, right, bottom = seen["frame"]
    screen = np.asarray(Image.open(seen["screen"]).convert("L")).astype(float) / 255
    view = screen[top + 30 : bottom - 60, left + 30 : right - 30]
    scanner = view[np.abs(view - np.median(view)) > 0.03]
    assert 0.15 < view.mean() < 0.6 and 0.15 < scanner.mean() < 0.6
    assert scanner.size > 0.08 * view.size, "the scanner stands out from the world"
    assert scanner.std() > 0.1, "it has lit sides and sides in shadow"


def test_commands_are_found_and_started_by_search(window, work_folder):
    seen = window("menus")
    assert seen["before"] == [False, "TRANSMISSION"] and seen["after"] == [True, "EMISSION"]


def test_tutorial(window, work_folder, monkeypatch):
    said = {name: words for name, words in window("tutorial").items() if name not in ("ok", "screen")}
    sections = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    texts = {picture: text for text in sections for picture in re.findall(r"images/tutorial/(\w+)\.webp", text)}
    assert list(said) == list(texts), "a step for each picture"
    missing = {name: [words for words in said[name] if words not in " ".join(texts[name].split())] for name in said}
    assert not any(missing.values()), f"what was seen is not what the page says: {missing}"

    code, printed = re.findall(r"```(?:python|text)\n(.*?)```", "".join(sections), flags=re.DOTALL)
    monkeypatch.chdir(work_folder)
    with contextlib.redirect_stdout(io.StringIO()) as output:
        exec(code, {})
    assert output.getvalue() == printed


def test_how_tall_the_tab_is_with_everything_open(window):
    seen = window("panels")
    assert 1500 < seen["height"] <= 2500
