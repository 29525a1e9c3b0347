"""A second kind of scanner, which this file alone defines: two X-ray sources and two panels, in the scene and projected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import bpy
import numpy as np
import openpyxl
import pytest
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

import mphdrr.core as mph
from mphdrr.addon import registration
from mphdrr.addon.blender import storage
from mphdrr.addon.runs import runs
from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import volumes
from mphdrr.core.errors import InputError
from mphdrr.core.geometry import scanner as kinds
from mphdrr.core.geometry.columns import Column, ColumnTable
from mphdrr.core.geometry.frames import affine_matrix
from mphdrr.core.geometry.module_parts import BOX_FACES, ModulePart
from mphdrr.core.geometry.scanner import Scanner
from mphdrr.core.geometry.views import Views
from mphdrr.core.runs.files import read_run
from mphdrr.core.workbook import read_scanner


def vector(name: str, attribute: str) -> list[Column]:
    return [
        Column(f"{name}_{axis}", attribute, axis=i, headings=(f"{name}_{axis}",), help=f"{axis} of {name}")
        for i, axis in enumerate("xyz")
    ]


COLUMNS = ColumnTable(
    (
        *vector("source", "sources"),
        *vector("panel", "panel_centers"),
        *vector("u", "panel_u"),
        *vector("v", "panel_v"),
        Column("width", "panel_width", headings=("width",), help="width of the panel", plausible=(10, 2000)),
        Column("height", "panel_height", headings=("height",), help="height of the panel", plausible=(10, 2000)),
        Column(
            "turn", "gantry_angle", headings=("turn",), kind="angle", unit="deg", blank=0.0, help="angle of the gantry"
        ),
        Column("frames", "frames_per_turn", headings=("frames",), kind="whole", blank=1, help="frames in a turn"),
        Column(
            "tube",
            "anode",
            headings=("tube",),
            kind="choice",
            choices=("W", "Mo", "Rh"),
            blank="W",
            help="metal of the anode",
        ),
        Column("serial", "serial_number", headings=("serial",), kind="text", blank="", help="serial number"),
    )
)


@pytest.fixture
def xray():
    """The class, known while a test runs."""

    @dataclass(frozen=True, eq=False)
    class Xray(Scanner):
        kind: ClassVar[str] = "toy x-ray"
        sheet: ClassVar[str] = "C-arms"
        columns: ClassVar[ColumnTable] = COLUMNS

        sources: Any
        panel_centers: Any
        panel_u: Any
        panel_v: Any
        panel_width: Any
        panel_height: Any
        numbers: Any = None
        source: Any = None
        gantry_angle: Any = 0.0
        frames_per_turn: Any = 1
        anode: Any = "W"
        serial_number: Any = ""
        more: Mapping[str, Any] = field(default_factory=dict)

        def poses(self) -> Any:
            axes = np.stack([self.panel_u, self.panel_v, np.cross(self.panel_u, self.panel_v)], axis=2)
            return affine_matrix(axes, self.sources)

        def attributes_at(self, poses: Any) -> dict[str, Any]:
            motion = poses @ np.linalg.inv(self.poses())
            turned = {
                name: (motion[:, :3, :3] @ getattr(self, name)[..., None])[..., 0] for name in ("panel_u", "panel_v")
            }
            middle = (motion[:, :3, :3] @ self.panel_centers[..., None])[..., 0] + motion[:, :3, 3]
            return {"sources": poses[:, :3, 3], "panel_centers": middle, **turned}

        def views(self, shape=(256, 256), detector="virtual", magnification=10.0, pitch=None, offset=(0, 0)) -> Views:
            n_v, n_u = shape
            u, v = self.panel_u * self.panel_width[:, None] / n_u, self.panel_v * self.panel_height[:, None] / n_v
            return Views(self.sources, self.panel_centers, u, v, shape)

        def parts(self, construction: Any = None) -> list[ModulePart]:
            found, poses = [], self.poses()
            poses[:, :3, [0, 2]] *= -1
            for m, (x, y, depth, width, height) in enumerate(self.fields().tolist()):
                z = np.array([-depth - 5.0, -depth])
                corners = [[x + i * width / 2, y + j * height / 2, d] for d in z for i, j in SQUARE]
                number = int(self.numbers[m])
                found.append(ModulePart(number, "crystal", f"Panel {number}", (np.array(corners), BOX_FACES), poses[m]))
            return found

        def rings(self) -> Any:
            return np.arange(len(self))

    registration.unregister()
    registration.register()
    yield Xray
    registration.unregister()
    del kinds.SCANNERS[Xray.kind]
    registration.register()


SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1))


@pytest.fixture
def system(xray, tmp_path):
    """Two sources, each opposite a panel that is neither square nor in the middle, from a sheet of a workbook."""
    values = {
        "source": [[-700.3, 20.1, -5.0], [30.7, 650.9, 12.0]], "panel": [[420.0, -33.3, 40.7], [-25.0, -380.0, -21.1]],
        "u": [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], "v": [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]],
    }  # fmt: skip
    values["u"][1] = [-1.0, 0.0, 0.0]  # so that u, v and the direction to the panel are right-handed
    rows = {f"{name}_{axis}": np.array(v)[:, i] for name, v in values.items() for i, axis in enumerate("xyz")}
    rows |= {"width": np.array([400.1, 380.0]), "height": np.array([300.0, 285.3]), "turn": np.radians([12.3, 45.6])}
    rows |= {"frames": np.array([360, 720]), "tube": np.array(["W", "Mo"]), "serial": np.array(["A-17 é", ""])}
    book = openpyxl.Workbook()
    book.active.title = xray.sheet
    book.active.append(["number", *rows])
    for m, number in enumerate((3, 8)):
        own = {**rows, "turn": np.degrees(rows["turn"])}
        book.active.append([number, *(values[m].item() for values in own.values())])
    book.save(tmp_path / "toy.xlsx")
    read = read_scanner(tmp_path / "toy.xlsx", xray.kind)
    made = xray.from_values(rows, numbers=[3, 8])
    assert all(
        np.allclose(a, b) if a.dtype.kind != "U" else np.array_equal(a, b)
        for a, b in zip(read.values().values(), made.values().values(), strict=True)
    )
    return read


def assert_same(one: Scanner, other: Scanner) -> None:
    assert type(one) is type(other) and one.numbers.tolist() == other.numbers.tolist()
    for name, values in one.values().items():
        assert np.array_equal(values, other.values()[name]), name


def test_it_is_shown_saved_reopened_and_read_back(scene, system, tmp_path):
    collection = scanner.build_scanner(scene, system, "C-arms")
    assert collection.mphdrr_scanner.kind == "toy x-ray" and [c.name for c in collection.children] == [
        "Ring 1",
        "Ring 2",
    ]
    assert not any(o.mphdrr_module.part == "ROI" for o in collection.all_objects)
    bpy.context.view_layer.update()
    assert_same(scanner.read_scanner(collection), system)
    assert scanner.losses(collection) == [] and scanner.aim_modules(collection) == []
    path = str(tmp_path / "toy.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    assert_same(scanner.read_scanner(scanner.active_scanner(bpy.context.scene)), system)


def test_its_cameras_see_what_its_views_show(scene, system):
    shape = (30, 50)
    collection = scanner.build_scanner(scene, system[:1], shape=shape)
    bpy.context.view_layer.update()
    (camera,) = scanner.modules(collection)
    _, targets = system.views(shape).rays(0)
    n_v, n_u = shape
    seen = np.array([world_to_camera_view(scene, camera, Vector(target))[:2] for target in targets])
    i, j = np.divmod(np.arange(n_v * n_u), n_u)
    # Seen from the source +u is to the left, and +v is up.
    assert np.allclose(seen, np.stack([1 - (j + 0.5) / n_u, (i + 0.5) / n_v], axis=1), atol=2e-6)


def test_it_is_projected_and_its_run_is_current_until_it_moves(scene, system):
    collection = scanner.build_scanner(scene, system)
    grid = mph.Grid.centered((20, 24, 16), 8.0)
    array = np.random.default_rng(1).uniform(0.0, 0.02, grid.shape).astype(np.float32)
    volumes.add_volume(mph.Volume(array, grid, "mu"), "Box")
    panel = scene.mphdrr_projections
    panel.model, panel.width, panel.height = "TRANSMISSION", 20, 15
    assert bpy.ops.mphdrr.render_projections() == {"FINISHED"}
    run = read_run(storage.absolute(scene.mphdrr_projections.run_file))
    expected = mph.Projector(grid, system.views((15, 20)), model=mph.Transmission(), backend="numpy")(array)
    assert np.allclose(run.projections, expected, atol=1e-3 * expected.max()) and expected.min() < expected.max()
    assert_same(run.system, system)
    assert runs.changes(scene) == []
    scanner.module(collection, 8).location.z += 2.0
    bpy.context.view_layer.update()
    assert runs.changes(scene) == ["Module 08 moved"]


def test_its_modules_are_moved_turned_edited_and_renumbered(scene, system):
    collection = scanner.build_scanner(scene, system)
    bpy.context.view_layer.update()
    first, second = scanner.modules(collection)
    second.rotation_euler.z += 0.1
    second.location.x += 3.0
    first.mphdrr_module.panel_width, first.mphdrr_module.anode = 250.0, "Rh"
    first.mphdrr_module.gantry_angle, first.mphdrr_module.serial_number = np.radians(30.0), "B-2"
    second.mphdrr_module.frames_per_turn = 90
    bpy.context.view_layer.update()
    read = scanner.read_scanner(collection)
    turn = np.array([[np.cos(0.1), -np.sin(0.1), 0], [np.sin(0.1), np.cos(0.1), 0], [0, 0, 1]])
    assert np.allclose(read.panel_u[1], turn @ system.panel_u[1], atol=1e-6)
    arm = turn @ (system.panel_centers[1] - system.sources[1])
    assert np.allclose(read.panel_centers[1] - read.sources[1], arm, atol=1e-3)
    assert read.sources[1].tolist() == [pytest.approx(33.7), 650.9, 12.0]
    assert np.array_equal(read.panel_centers[0], system.panel_centers[0])
    assert read.panel_width.tolist() == [250.0, 380.0] and read.anode.tolist() == ["Rh", "Mo"]
    assert read.gantry_angle[0] == np.radians(30.0) and read.serial_number.tolist() == ["B-2", ""]
    assert read.frames_per_turn.tolist() == [360, 90]
    assert scanner.losses(collection) == ["module 8 moved or turned", "modules 3, 8 with changed numbers"]
    depth = np.array([v.co for v in first.children[0].data.vertices])
    assert np.ptp(depth[:, 0]) == pytest.approx(250.0), "its panel's solid follows"
    collection.mphdrr_scanner.anode = "Mo"
    assert scanner.read_scanner(collection).anode.tolist() == ["Mo", "Mo"]
    assert bpy.ops.mphdrr.renumber_modules() == {"FINISHED"}
    assert scanner.read_scanner(collection).numbers.tolist() == [1, 2]
    bpy.ops.mphdrr.duplicate_modules(count=1, angle=0.4)
    assert len(scanner.read_scanner(collection)) == 3
    with pytest.raises(RuntimeError, match="no checks of a scanner of the kind toy x-ray"):
        bpy.ops.mphdrr.check_geometry()


def test_a_kind_that_is_not_known_is_refused(scene, system):
    collection = scanner.build_scanner(scene, system)
    collection.mphdrr_scanner.kind = "of another extension"
    with pytest.raises(InputError, match="of another extension"):
        scanner.read_scanner(collection)


def test_its_workbook_is_imported_and_written(scene, system, tmp_path):
    assert bpy.ops.mphdrr.import_geometry(filepath=str(tmp_path / "toy.xlsx")) == {"FINISHED"}
    collection = scanner.active_scanner(scene)
    assert_same(scanner.read_scanner(collection), system)
    scanner.module(collection, 8).mphdrr_module.anode = "Rh"
    bpy.context.view_layer.update()
    assert bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "edited.xlsx")) == {"FINISHED"}
    assert_same(read_scanner(tmp_path / "edited.xlsx", system.kind), system.replace(anode=["W", "Rh"]))
