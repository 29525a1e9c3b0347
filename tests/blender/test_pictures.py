"""Pictures and animations for papers: the phantom is on each, on the paper that was asked for."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from PIL import Image

import mphdrr.core as mph
from mphdrr.addon.blender import jobs
from mphdrr.addon.cli import main
from mphdrr.addon.figures import figures
from mphdrr.addon.figures.stage import FigureScene
from mphdrr.addon.scanner import scanner, selection
from mphdrr.addon.volumes import volumes
from mphdrr.core.recording import recorded_warnings

SIZE = (192, 120)
PAPERS = {"dark": (20, 22, 26), "light": (255, 255, 255)}


@pytest.fixture
def example(scene, dc_spect):
    scanner.build_scanner(scene, dc_spect[::8])
    volume = mph.DerenzoPhantom(40, (12, 10, 8, 8, 6, 6), 40, 100).voxelize(mph.Grid.centered(24, 4.0))
    return volumes.add_volume(volume, "Derenzo")


def picture(path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def share_of_phantom(shown: np.ndarray) -> float:
    """Of pixels that are purple or pink, as activity is and nothing else."""
    red, green, blue = np.moveaxis(shown, -1, 0)
    return float(np.mean((red - green > 40) & (blue - green > 20)))


def share_of_paper(shown: np.ndarray, style: str) -> float:
    return float(np.mean((np.abs(shown - PAPERS[style]) <= 2).all(axis=-1)))


def share_of_lit(shown: np.ndarray) -> float:
    """Of pixels in the orange of rays and lit modules."""
    return float(np.mean(shown[..., 0] - shown[..., 2] > 60))


def test_a_picture_shows_the_phantom_on_its_paper(example, tmp_path):
    """On light paper; animations are on dark."""
    path, style = tmp_path / "picture.png", "light"
    common = {"filepath": str(path), "style": style, "width": SIZE[0], "height": SIZE[1], "samples": 2}
    bpy.ops.mphdrr.render_picture(**common, labels=False)
    shown = picture(path)
    assert share_of_phantom(shown) > 0.02 and share_of_paper(shown, style) > 0.1 and share_of_lit(shown) > 0.02
    for other in set(PAPERS) - {style}:
        assert share_of_paper(shown, other) < 0.02


def test_an_animation_has_the_phantom_on_its_first_and_last_picture(example, tmp_path):
    left, right = scanner.modules(scanner.active_scanner(bpy.context.scene))[3:5]
    selection.select(bpy.context, (left, right))
    for kind in ("TURNTABLE", "LIGHT_UP"):
        path, folder = tmp_path / f"{kind}.mp4", tmp_path / f"{kind}-frames"
        folder.mkdir()
        (folder / f"{kind}-0099.png").touch()  # of a longer one before
        bpy.ops.mphdrr.render_animation(
            filepath=str(path), figure=kind, width=SIZE[0], height=SIZE[1], samples=1, seconds=0.2, fps=10, labels=False
        )
        frames = sorted(folder.iterdir())
        assert [frame.name for frame in frames] == [f"{kind}-{k:04d}.png" for k in (1, 2)]
        first, last = picture(frames[0]), picture(frames[-1])
        assert min(share_of_phantom(first), share_of_phantom(last)) > 0.008
        assert min(share_of_paper(first, "dark"), share_of_paper(last, "dark")) > 0.1
        assert np.abs(first - last).max() > 60, "something happens"
        clip = bpy.data.movieclips.load(str(path))
        assert (tuple(clip.size), clip.frame_duration, clip.fps) == (SIZE, 2, 10)
    assert share_of_lit(last) > share_of_lit(first), "the second module is lit beside the first"
    assert not [scene for scene in bpy.data.scenes if scene.name.startswith("mphDRR")]


def test_an_animation_that_is_ended_keeps_its_pictures(example, tmp_path, monkeypatch):
    monkeypatch.setattr(
        figures, "_render_pixels", lambda scene: (yield) or np.full((SIZE[1], SIZE[0], 3), 200, np.uint8)
    )
    monkeypatch.setattr(figures, "_are_visible", lambda *_: (yield) or True)
    path = tmp_path / "film.mp4"
    path.write_bytes(b"older")

    def started(**more):
        job = figures.figure_job(bpy.context, "turntable", [path], SIZE, seconds=1.0, fps=9, **more)
        steps = job.finish(job.work(lambda done, total: None))
        while next(steps) != ("rendering pictures", 3, 9):
            pass
        return job, steps

    job, steps = started()
    with pytest.raises(mph.Cancelled):
        steps.throw(mph.Cancelled())
    assert job.leftovers() == f"3 pictures are in {tmp_path / 'film-frames'}"
    assert len(list((tmp_path / "film-frames").iterdir())) == 3 and path.read_bytes() == b"older"
    job, steps = started()
    job.finish_now.set()
    list(steps)
    assert bpy.data.movieclips.load(str(path)).frame_duration == 3
    assert sorted(found.name for found in tmp_path.iterdir()) == ["film-frames", "film.mp4"]


def test_a_volume_that_cycles_does_not_draw_is_a_surface(example, tmp_path, monkeypatch):
    """As in a Blender whose Cycles draws no volumes: here the stage has it far away."""
    put = FigureScene._add_volume

    def put_far_away(stage: FigureScene, item: bpy.types.Object) -> None:
        put(stage, item)
        stage.volume_objects[0].location.z += 1e5

    monkeypatch.setattr(FigureScene, "_add_volume", put_far_away)
    path = tmp_path / "picture.png"
    with recorded_warnings() as said:
        jobs.run(figures.figure_job(bpy.context, "picture", [path], SIZE, labels=False, samples=2))
    (text,) = said
    assert text.startswith("the picture shows 'Derenzo' as the surface at 50 kBq/mL") and "no volumes" in text
    assert share_of_phantom(picture(path)) > 0.02


def test_animations_refuse_what_cannot_be(tmp_path, capsys):
    common = ["figure", "light-up", "scene.blend", "-o"]
    for words, said in (
        (["a.png"], "expected a name ending in .mp4"),
        (["a.mp4", "--size", "321x200"], "size 321x200: both must be even for an animation"),
        (["a.mp4", "--seconds", "0"], "0 s of 24 pictures each: expected more than 0 for both"),
    ):
        assert main([*common, str(tmp_path / words[0]), *words[1:]]) == 1
        assert said in capsys.readouterr().err
