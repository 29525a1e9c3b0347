"""Figures drawn by the operator in the window, as a job, and by the command without one are the same."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

SCRIPT = Path(__file__).with_name("window_figure.py")
WORKBOOK = Path(__file__).resolve().parents[2] / "examples" / "dc-spect-80.xlsx"
SIZE = "360x240"


def ssim(a: np.ndarray, b: np.ndarray, side: int = 8) -> float:
    """Structural similarity of two grey pictures (0 to 255), mean over windows of side x side pixels (Wang et al. 2004)."""
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


def test_window_and_command_draw_the_same_figures(blender, blender_script, blender_window, work_folder):
    result_file, blend = work_folder / "seen.json", work_folder / "scene.blend"
    blender_window(SCRIPT.read_text(encoding="utf-8"), WORKBOOK, work_folder, result_file)
    seen = json.loads(result_file.read_text())
    assert seen["ok"], seen
    assert seen["scenes"] == 1 and seen["display"] == ["WINDOW", "WINDOW"]
    assert seen["ticks"] > 3, "the window was alive while the figure was rendered"
    for kind in ("cut-away", "sums"):
        path = work_folder / f"{kind}-command.png"
        done = blender("--command", "mphdrr", "figure", kind, blend, "--size", SIZE, "--samples", "8", "-o", path)
        colors = np.asarray(Image.open(path).convert("RGB")).astype(int)
        is_drawn = kind != "cut-away" or np.count_nonzero(colors[..., 0] - colors[..., 1] > 40) > 100  # its purple
        assert ("the picture shows nothing of" in done.stdout + done.stderr) != is_drawn
        own, other = (np.asarray(Image.open(p).convert("L")) for p in (work_folder / f"{kind}.png", path))
        assert own.std() > 15, "something is to be seen"
        assert ssim(own, other) > 0.99
        assert ssim(own, np.roll(other, 3, axis=1)) < 0.95, "the measure tells pictures apart"
    done = blender_script(RENDER, blend, work_folder / "render.png")
    shown = np.asarray(Image.open(work_folder / "render.png").convert("RGB")).astype(int)
    is_drawn = np.count_nonzero(shown[..., 0] - shown[..., 1] > 40) > 100
    assert ("mphDRR: the picture shows nothing of" in done.stdout + done.stderr) != is_drawn
    assert ("mphDRR: the picture shows nothing of" in seen["said"]) != is_drawn, "the same in the window"
