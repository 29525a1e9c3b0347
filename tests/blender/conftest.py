"""Every test gets a fresh factory scene in which the extension is registered; without bpy they are skipped."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

bpy = pytest.importorskip("bpy", reason="needs Blender's Python module: pip install mphdrr[blender]")

from mathutils import Matrix  # noqa: E402

from mphdrr.addon import registration  # noqa: E402
from mphdrr.addon.blender import jobs, plots, timers  # noqa: E402
from mphdrr.addon.events import event_notes  # noqa: E402
from mphdrr.addon.pictures import recoloring  # noqa: E402
from mphdrr.addon.runs import preview  # noqa: E402
from mphdrr.addon.scanner import scanner  # noqa: E402
from mphdrr.core.geometry.scanner import Scanner  # noqa: E402
from mphdrr.core.geometry.system import PinholeSystem  # noqa: E402
from mphdrr.core.progress import Cancelled  # noqa: E402
from mphdrr.core.volumes.volume import Volume  # noqa: E402
from mphdrr.core.workbook import read_system, write_system  # noqa: E402

WORKBOOK = Path(__file__).parents[2] / "examples" / "dc-spect-80.xlsx"


@pytest.fixture(scope="session")
def registered() -> Iterator[None]:
    """Register the extension in a Blender of factory settings, once: it takes longer than a scene.

    The tests in tests/field have this fixture, too, in the same process.
    """
    if hasattr(bpy.types.Scene, "mphdrr_display"):
        yield
        return
    bpy.ops.wm.read_factory_settings()
    registration.register()
    yield
    registration.unregister()


@pytest.fixture(autouse=True)
def scene(registered: None) -> Iterator[bpy.types.Scene]:
    """Yield a fresh factory scene; then stop all that is going on, as when the extension is disabled."""
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    shutil.rmtree(Path(bpy.app.tempdir, "mphdrr"), ignore_errors=True)
    yield bpy.context.scene
    for module in (jobs, preview, plots, recoloring, event_notes, timers):
        module.stop()


@pytest.fixture(scope="session")
def workbook() -> Path:
    return WORKBOOK


@pytest.fixture(scope="session")
def dc_spect() -> PinholeSystem:
    """Return the real scanner: 80 modules in 4 rings."""
    return read_system(WORKBOOK)


@pytest.fixture(scope="session")
def small_workbook(dc_spect, tmp_path_factory) -> Path:
    """Write the real scanner's first 16 modules into a workbook of the same layout."""
    path = tmp_path_factory.mktemp("workbook") / "small.xlsx"
    write_system(dc_spect[:16], path)
    return path


@pytest.fixture
def ring_system() -> PinholeSystem:
    """Return two rings of four modules of different sizes: small, and nothing in it symmetric."""
    angle = np.radians([-80.0, -20.0, 35.0, 120.0])
    radius = np.array([180.0, 210.0, 195.0, 240.0])
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(4, -30.0)], axis=1)
    centers = np.concatenate([ring, ring * [1.0, 1.0, -1.3]])
    centers[:, 0] += 0.1234567890123
    return PinholeSystem(centers, 2.3, np.linspace(50.0, 71.0, 8) / 1.00000001, 48.0, 9.5, 60.0)


@pytest.fixture
def ring(scene, ring_system) -> bpy.types.Collection:
    """Build the scanner of `ring_system` in the scene."""
    collection = scanner.build_scanner(scene, ring_system, "Ring")
    update()
    return collection


@pytest.fixture
def imported(scene, small_workbook) -> bpy.types.Collection:
    """Import the scanner of the small workbook into the scene."""
    assert bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook)) == {"FINISHED"}
    return scanner.active_scanner(scene)


@pytest.fixture
def derenzo(ring) -> bpy.types.Object:
    """Add a small phantom to the ring of eight modules, off centre and rotated; it is active."""
    bpy.ops.mphdrr.add_derenzo(voxels=32, rod_diameters=(10, 8, 0, 0, 0, 0), location=(5, -3, 2), phi=0.2, theta=0.3)
    return bpy.context.object


def update() -> None:
    bpy.context.view_layer.update()


def move(item: bpy.types.Object, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> None:
    """Move an object by (x, y, z) mm, as a user does: the scene is up to date afterwards."""
    item.location = np.add(item.location, (x, y, z))
    update()


def turn(item: bpy.types.Object, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> None:
    """Add (x, y, z) radians to an object's Euler angles, as a user does: the scene is up to date afterwards."""
    item.rotation_euler = np.add(item.rotation_euler, (x, y, z))
    update()


def select(*items: bpy.types.Object) -> None:
    """Select these objects alone; the first becomes active."""
    bpy.ops.object.select_all(action="DESELECT")
    for item in items:
        item.select_set(True)
    bpy.context.view_layer.objects.active = items[0]
    update()


def part(camera: bpy.types.Object, name: str) -> bpy.types.Object:
    """Return a part of a module: COLLIMATOR, CRYSTAL or PLANE."""
    return next(child for child in camera.children if child.mphdrr_module.part == name)


def module(number: int) -> bpy.types.Object:
    """Return the camera of a module of the active scanner."""
    return scanner.module(scanner.active_scanner(bpy.context.scene), number)


def reopened(path: Path) -> bpy.types.Scene:
    """Save the file, open it again, and return its scene."""
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    bpy.ops.wm.open_mainfile(filepath=str(path))
    return bpy.context.scene


def refused(operator: Callable[..., Any], words: str, **arguments: Any) -> None:
    """Check that an operator refuses these arguments in one line, which matches `words`."""
    with pytest.raises(RuntimeError, match=words) as refusal:
        operator(**arguments)
    assert len(str(refusal.value).strip().splitlines()) == 1 and "context is incorrect" not in str(refusal.value)


def cancelled(job: jobs.Job, condition: Callable[[int, int], bool]) -> None:
    """Run a job until its progress (done, total) meets the condition, and check that it is cancelled there."""

    def progress(done: int, total: int) -> None:
        if condition(done, total):
            raise Cancelled

    with pytest.raises(Cancelled):
        jobs.run(job, progress)


def assert_same(one: Scanner, other: Scanner, tolerance: float = 0.0) -> None:
    """Check that two scanners are of one kind and have the same numbers and values."""
    assert type(one) is type(other) and one.numbers.tolist() == other.numbers.tolist()
    for name, values in one.values().items():
        if tolerance and values.dtype.kind == "f":
            np.testing.assert_allclose(values, other.values()[name], rtol=tolerance, atol=tolerance, err_msg=name)
        else:
            np.testing.assert_array_equal(values, other.values()[name], err_msg=name)


def centroid(volume: Volume) -> np.ndarray:
    """Return the centroid (x, y, z) of a volume's values in the world, mm."""
    index = np.average(np.argwhere(np.ones(volume.grid.shape)), axis=0, weights=volume.array.ravel().astype(float))
    return volume.grid.affine[:3] @ [*index, 1.0]


def datablocks(*kinds: str) -> dict[str, list[str]]:
    """Return the names of the file's datablocks by kind: all kinds, or these."""
    names = [name for name in kinds or dir(bpy.data) if not name.startswith("_")]
    collections = {name: getattr(bpy.data, name) for name in names}
    return {
        name: sorted(block.name for block in blocks)
        for name, blocks in collections.items()
        if isinstance(blocks, bpy.types.bpy_prop_collection)
    }


def pixels(image: bpy.types.Image) -> np.ndarray:
    """Return the colours (rows from the bottom, columns from the left, 4) of an image."""
    values = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)


def slice_pixels(plane: bpy.types.Object) -> np.ndarray:
    """Return the colours that a slice of a volume shows, as `pixels` does."""
    return pixels(plane.data.materials[0].node_tree.nodes["Slice"].image)


def cycles_picture(scene: bpy.types.Scene, samples: int) -> np.ndarray:
    """Render the scene in no world's light by Cycles, and return its linear colours as `pixels` does."""
    scene.world = None
    scene.render.engine, scene.render.resolution_percentage = "CYCLES", 100
    scene.cycles.samples, scene.cycles.use_denoising = samples, False
    scene.view_settings.view_transform = "Raw"
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(Path(bpy.app.tempdir, "picture.exr"))
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    colors = pixels(image)
    bpy.data.images.remove(image)
    return colors


def volume_picture(
    scene: bpy.types.Scene, axes: tuple[int, int], aim: np.ndarray, width: float, side: int, samples: int
) -> np.ndarray:
    """Render the scene's volumes alone as `cycles_picture`, by an orthographic camera.

    The picture has `side` x `side` pixels and is `width` mm wide around `aim`; the world axes `axes` lead to its right
    and upwards.
    """
    bpy.data.batch_remove([item for item in scene.objects if item.type != "VOLUME"])
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(scene.camera)
    camera = scene.camera.data
    camera.type, camera.ortho_scale, camera.clip_end = "ORTHO", width, 1000.0
    right, up = np.eye(3)[list(axes)]
    back = np.cross(right, up)
    pose = np.eye(4)
    pose[:3] = np.stack([right, up, back, aim + 200.0 * back], axis=1)
    scene.camera.matrix_world = Matrix(pose)
    scene.render.resolution_x = scene.render.resolution_y = side
    return cycles_picture(scene, samples)


class Drawn:
    """A drawn panel: calls of its layout, the texts that it shows, and the owner of each property by name."""

    def __init__(self, name: str, is_polled: bool = True) -> None:
        self.panel, self.layout = getattr(bpy.types, name), MagicMock()
        for kind in ("box", "column", "row", "split"):
            getattr(self.layout, kind).return_value = self.layout
        assert not is_polled or not hasattr(self.panel, "poll") or self.panel.poll(bpy.context)
        self.panel.draw(self, bpy.context)
        self.calls = self.layout.mock_calls
        self.texts = [options["text"] for _, _, options in self.calls if options.get("text")]
        self.properties = {
            call.args[1].removesuffix("_unset"): call.args[0] for call in self.layout.prop.call_args_list
        }

    def __getattr__(self, name: str) -> Any:
        return functools.partial(getattr(self.panel, name), self)
