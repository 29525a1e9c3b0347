"""Looks of volumes (surfaces, cuts in front of slices, colours that tell things apart), and maps of the scanner."""

from __future__ import annotations

import colorsys

import bpy
import numpy as np
import pytest
from scipy import ndimage

from mphdrr.addon.blender import jobs
from mphdrr.addon.perspective import color_bar
from mphdrr.addon.scanner import maps, scanner
from mphdrr.addon.volumes import looks, slices, volume_materials, volumes
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.geometry.part_colors import LOOKS
from mphdrr.core.phantoms.nema import NemaBody
from mphdrr.core.physics.ct_numbers import hu_to_mu
from mphdrr.core.physics.maps import sensitivity_map
from mphdrr.core.physics.materials import attenuation
from mphdrr.core.physics.performance import sensitivity
from mphdrr.core.runs.display import Display
from mphdrr.core.volumes.volume import Volume

from .conftest import datablocks, refused, reopened, slice_pixels, update


@pytest.fixture(scope="module")
def body() -> Volume:
    return NemaBody().voxelize(Grid.centered(64, 4.8))


@pytest.fixture
def nema(scene, body):
    return volumes.add_volume(body, "NEMA Body")


def surface(item, number: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) in the object's space and edges (m, 2) of a surface that Blender draws."""
    made = looks.surfaces_of(item)[number]
    update()
    mesh = made.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    vertices = np.array([made.matrix_local @ vertex.co for vertex in mesh.vertices]).reshape(-1, 3)
    return vertices, np.array([edge.vertices for edge in mesh.edges]).reshape(-1, 2)


def test_a_shell_shows_the_six_spheres_where_they_are(nema):
    nema.mphdrr_volume.look = "SHELL"
    vertices, edges = surface(nema)
    part = np.arange(len(vertices))
    while not np.array_equal(part[edges[:, 0]], part[edges[:, 1]]):
        np.minimum.at(part, edges, part[edges].min(axis=1, keepdims=True))
    found = [vertices[part == k] for k in np.unique(part)]
    assert len(found) == 6
    angles = np.radians(60 * np.arange(6))
    expected = 57.2 * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(6)])
    middles = np.array([(sphere.min(axis=0) + sphere.max(axis=0)) / 2 for sphere in found])
    assert np.linalg.norm(middles[:, None] - expected, axis=2).min(axis=0).max() < 1.0


def test_what_lies_in_front_of_the_slices_is_cut_away_and_comes_back(nema):
    before = datablocks("objects", "materials", "node_groups", "images")
    settings = nema.mphdrr_volume
    settings.look = "CUT"
    assert len(slices.planes_of(nema)) == 3
    for index in ((32, 32, 40), (20, 40, 30)):
        settings.slices = index
        at = slices._read_volume(nema).grid.affine @ [*index, 1.0]
        vertices, _ = surface(nema)
        inside = ((vertices - at[:3]) * [1, -1, 1] > 5.0).all(axis=1)  # mm: a face reaches as far as a voxel
        assert len(vertices) > 1000 and not inside.any()
        for axis, sign in enumerate((1, -1, 1)):  # the material's nodes say the same
            nodes = nema.data.materials[0].node_tree.nodes
            normal = np.array(nodes[f"Cut {axis} along"].inputs[1].default_value)
            limit = nodes[f"Cut {axis}"].inputs[1].default_value
            for offset, beyond in ((-0.1, False), (0.1, True)):
                point = at[:3] + sign * offset * np.eye(3)[axis]
                assert (normal @ point > limit) == beyond
    slices.remove_slices(nema)
    vertices, _ = surface(nema)
    assert ((vertices - at[:3]) * [1, -1, 1] > 5.0).all(axis=1).any()
    settings.look = "DENSITY"
    assert datablocks("objects", "materials", "node_groups", "images") == before


def test_a_look_from_the_asset_library_restyles_a_volume_and_its_slices(nema, tmp_path):
    plane = slices.add_slices(nema)[2]
    nema.mphdrr_volume.display_high = 3.0
    before = datablocks("materials", "node_groups")
    assert bpy.ops.mphdrr.add_looks(directory=str(tmp_path)) == {"FINISHED"}
    assert datablocks("materials", "node_groups") == before
    assert bpy.context.preferences.filepaths.asset_libraries["mphDRR"].path == str(tmp_path)
    with bpy.data.libraries.load(str(tmp_path / "mphdrr-looks.blend"), assets_only=True) as (there, wanted):
        assert len(there.materials) == 6
        wanted.materials = ["mphDRR Fire"]
    nema.material_slots[0].material = bpy.data.materials["mphDRR Fire"]  # as a drop does
    look = nema.data.materials[0].node_tree.nodes["Look"]

    def brightest() -> np.ndarray:
        update()
        colors = slice_pixels(plane)[..., :3].reshape(-1, 3)
        return colors[colors.sum(axis=1).argmax()]

    assert np.allclose(brightest(), slices.color_table("", volume_materials.item_ramp(nema))[-1, :3], atol=0.01)
    assert look.inputs["High"].default_value == 3.0 and brightest()[2] < brightest()[0]
    look.node_tree.nodes["Colors"].color_ramp.elements[-1].color = (1.0, 1.0, 1.0, 1.0)
    assert np.allclose(brightest(), 1.0, atol=0.01)
    own, other = plane.material_slots[0].material, volume_materials.new_material("Other", "mu", 9.0)
    plane.material_slots[0].material = other  # a drop on a slice is meant for the volume
    update()
    assert nema.data.materials[0] == other and plane.material_slots[0].material == own
    assert nema.data.materials[0].node_tree.nodes["Values"].attribute_name == "activity"


@pytest.mark.long
def test_a_surface_follows_a_phantom_that_changes(scene):
    bpy.ops.mphdrr.add_nema(voxels=64)
    nema = bpy.context.object
    settings = nema.mphdrr_volume
    settings.look = "SHELL"
    _, edges = surface(nema)
    settings.nema.sphere_activity, settings.nema.background = 2120.0, 530.0
    assert settings.surface == pytest.approx(0.6 * 2120.0)
    assert np.array_equal(surface(nema)[1], edges)
    settings.nema.quantity = "mu"
    assert 0 < settings.surface < settings.maximum and len(surface(nema)[0]) > 100


def test_smoke_gives_way_to_surfaces_and_slices(nema):
    display, settings = nema.data.display, nema.mphdrr_volume
    for look, smoke in (("DENSITY", True), ("BRIGHTEST", True), ("SHELL", False), ("DENSITY", True)):
        settings.look = look
        assert display.use_slice != smoke
    slices.add_slices(nema)
    assert display.use_slice
    slices.remove_slices(nema)
    assert not display.use_slice


def test_presets_of_a_ct(scene):
    array = np.full((9, 9, 9), -1000.0)
    array[2:7, 2:7, 2:7], array[4, 4, 4] = 40.0, 900.0
    item = volumes.add_volume(Volume(array, Grid.centered(9, 2.0), "hu"), "CT")
    sides = {}
    for look in ("BONE", "LUNG", "SOFT"):
        item.mphdrr_volume.look = look
        sides[look] = np.ptp(surface(item)[0], axis=0).max()
    assert sides["BONE"] < 4.0 and 8.0 < sides["SOFT"] < 12.0  # one voxel, and five to six
    assert (item.mphdrr_volume.display_low, item.mphdrr_volume.display_high) == (-160.0, 240.0)
    mu = volumes.add_volume(hu_to_mu(volumes.volume_from_object(item)), "mu").mphdrr_volume
    water, bone = attenuation("water", 140.5), attenuation("bone", 140.5)
    mu.look = "SOFT"
    assert mu.display_low < water < mu.display_high < bone and mu.unit == "1/mm"
    mu.look = "BONE"
    assert water < mu.surface < bone


def test_bones_stand_in_the_skin_which_is_cut_open_at_the_slices(scene):
    array = np.full((20, 20, 20), -1000.0)
    array[2:18, 2:18, 2:18], array[8:12, 8:12, 4:16] = -100.0, 900.0  # fat around a bone
    item = volumes.add_volume(Volume(array, Grid.centered(20, 2.0), "hu"), "CT")
    settings = item.mphdrr_volume
    assert settings.look == "BONE" and len(slices.planes_of(item)) == 3
    assert (settings.display_low, settings.display_high) == (-160.0, 240.0)
    bone, skin = surface(item)[0], surface(item, 1)[0]
    assert np.ptp(bone, axis=0) == pytest.approx([8.0, 8.0, 24.0], abs=2.0)
    assert np.ptp(skin, axis=0) == pytest.approx([32.0, 32.0, 32.0], abs=2.0)
    is_cut_away = lambda vertices: (vertices * [1, -1, 1] > 2.0).all(axis=1).any()  # noqa: E731
    assert is_cut_away(bone) and not is_cut_away(skin)


def test_a_ct_makes_way_for_its_attenuation_and_undo_brings_it_back(scene):
    volumes.add_volume(Volume(np.full((9, 9, 9), 40.0), Grid.centered(9, 2.0), "hu"), "CT")
    bpy.context.view_layer.objects.active = bpy.data.objects["CT"]
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.mphdrr.ct_to_attenuation() == {"FINISHED"}
    bpy.ops.ed.undo_push(message="made")
    mu = bpy.data.objects["CT mu"]
    assert bpy.data.objects["CT"].hide_get() and not mu.hide_get() and mu.mphdrr_volume.look == "BONE"
    update()
    assert [child.name for child in bpy.data.objects["CT"].children if child.visible_get()] == []
    water = attenuation("water", 140.5)
    assert mu.mphdrr_volume.display_low < water < mu.mphdrr_volume.display_high < mu.mphdrr_volume.surface
    bpy.ops.ed.undo()
    assert "CT mu" not in bpy.data.objects and not bpy.data.objects["CT"].hide_get()


def test_slices_of_nema_show_six_spheres_also_after_reopening(nema, tmp_path):
    slices.add_slices(nema)
    nema.mphdrr_volume.display_low = 6.0  # above the background
    at = np.linalg.inv(slices._read_volume(nema).grid.affine) @ [0, 0, 0, 1]  # the spheres' middles
    nema.mphdrr_volume.slices = np.rint(at[:3]).astype(int).tolist()
    reopened(tmp_path / "a.blend")
    assert ndimage.label(slice_pixels(slices.planes_of(bpy.data.objects["NEMA Body"])[2])[..., 3] > 0)[1] == 6


def test_a_plane_that_the_user_deleted_leaves_the_others_as_they_are(nema):
    first, second, _ = slices.add_slices(nema)
    bpy.data.objects.remove(first)
    start, step = slices.slice_track(nema, 2)
    slices.move_slice(nema, 1, 3)
    assert start.length > 0 and step.length == pytest.approx(nema.mphdrr_volume.spacing[2])
    assert second.location.length > 0 and slices.plane_names(nema)[0] == ""


def test_a_map_has_a_bar_in_the_unit_of_the_panels(scene, imported):
    bpy.ops.mphdrr.add_map(quantity="sensitivity", voxels=9)
    item = bpy.data.objects["Sensitivity map"]
    middle = 1e6 * volumes.volume_from_object(item).array[4, 4, 4]
    assert middle == pytest.approx(scene.mphdrr_geometry.scanner.mphdrr_scanner.sensitivity, rel=1e-5)
    title, texts = color_bar.labels(item)
    settings = item.mphdrr_volume
    assert title == "sensitivity, cps/MBq" and settings.minimum <= middle <= settings.maximum
    low, high = settings.display_low, settings.display_high
    for text, place in texts.items():
        assert float(text) == pytest.approx(low + place * (high - low), rel=1e-3, abs=1e-6)
    assert settings.maximum == pytest.approx(settings.display_high, rel=1e-3)
    assert len(slices.planes_of(item)) == 3


def test_a_map_of_an_older_file_is_shown_in_the_same_unit(scene, tmp_path):
    item = volumes.add_volume(Volume(np.full((3, 3, 3), 2e-4), Grid.centered(3, 1.0), "sensitivity"), "Map")
    settings = item.mphdrr_volume
    shown = settings.display_high
    settings.unit = "counts/decay"
    for name in ("minimum", "maximum", "display_low", "display_high"):
        setattr(settings, name, 1e-6 * getattr(settings, name))
    reopened(tmp_path / "a.blend")
    settings = bpy.data.objects["Map"].mphdrr_volume
    assert settings.unit == "cps/MBq" and settings.display_high == pytest.approx(shown) == pytest.approx(200.0)


def test_activity_has_the_colours_of_the_mosaic_on_slices_and_as_smoke(nema):
    values = np.linspace(0.0, 1.0, 256)
    expected = Display().colored(values, (0.0, 1.0)) / 255
    assert np.abs(slices.color_table("activity")[:, :3] - expected).max() < 0.025
    for smoke in (False, True):
        shown = slices.color_table("", volume_materials.item_ramp(nema, smoke))[:, :3]
        assert np.abs(shown - expected).max() < 0.025
    assert Display().colors == "inferno" == bpy.context.scene.mphdrr_display.colors.lower()


def test_crystals_maps_and_the_selection_share_no_hue(scene):
    theme = bpy.context.preferences.themes[0].view_3d
    assert volume_materials.ramp("hu") == volume_materials.ramp("mu") != volume_materials.ramp("activity")

    def hues(*colors) -> np.ndarray:
        return np.array([360 * colorsys.rgb_to_hsv(*color[:3])[0] for color in colors])

    def ramp(quantity) -> np.ndarray:
        positions, colors = zip(*volume_materials.ramp(quantity), strict=True)
        shares = np.linspace(0.1, 1.0, 40)
        return hues(*np.column_stack([np.interp(shares, positions, channel) for channel in np.transpose(colors)]))

    found = {
        "crystal": hues(LOOKS["crystal"].color), "map": ramp("resolution"),
        "selection": hues(theme.object_selected, theme.object_active),
    }  # fmt: skip
    for name, one in found.items():
        for other, two in found.items():
            apart = np.abs((one[:, None] - two + 180) % 360 - 180).min()
            assert name == other or apart > 12, f"{name} and {other}: {apart:.0f} degrees of hue apart"


def the_map(quantity="sensitivity"):
    (item,) = [o for o in volumes.volume_objects(bpy.context.scene) if o.mphdrr_volume.quantity == quantity]
    return item


def test_map_is_the_cores_within_the_roi(imported):
    assert bpy.ops.mphdrr.add_map(quantity="sensitivity", voxels=12) == {"FINISHED"}
    volume = volumes.volume_from_object(the_map())
    system = scanner.read_scanner(imported)
    expected = sensitivity_map(system, volume.grid).array
    affine = volume.grid.affine
    places = np.moveaxis(np.indices(volume.grid.shape), 0, -1) @ affine[:3, :3].T + affine[:3, 3]
    inside = np.linalg.norm(places, axis=-1) <= system.roi_radius.max()
    assert np.array_equal(volume.array, np.where(inside, expected, 0))
    assert the_map().mphdrr_volume.unit == "cps/MBq"


def test_map_follows_the_scanner_and_is_replaced(imported):
    bpy.ops.mphdrr.add_map(quantity="sensitivity", voxels=5, within_roi=False)
    before = volumes.volume_from_object(the_map())
    module = scanner.module(imported, 1).mphdrr_module
    module.pinhole_diameter = 4.0
    bpy.ops.mphdrr.add_map(quantity="sensitivity", voxels=5, within_roi=False)
    after = volumes.volume_from_object(the_map())
    middle = np.zeros((1, 3))
    gained = sensitivity(scanner.read_scanner(imported), middle)[0, 0] * (1 - (2.3 / 4.0) ** 2)
    assert after.array[2, 2, 2] - before.array[2, 2, 2] == pytest.approx(gained, rel=1e-4)


def test_each_scanner_has_its_own_map_and_no_other_volume_is_replaced(imported, scene, small_workbook):
    volumes.add_volume(Volume(np.ones((3, 3, 3)), Grid.centered(3, 1.0), "sensitivity"), "Measured")
    bpy.ops.mphdrr.add_map(quantity="sensitivity", voxels=3, within_roi=False)
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook), name="Other")
    other = scanner.active_scanner(scene)
    scanner.module(other, 1).mphdrr_module.pinhole_diameter = 4.6
    for _ in range(2):
        bpy.ops.mphdrr.add_map(quantity="sensitivity", voxels=3, within_roi=False)
    of_other, of_first = (bpy.data.objects[name] for name in ("Sensitivity map.001", "Sensitivity map"))
    assert len(volumes.volume_objects(scene)) == 3 and np.all(volumes.volume_from_object(of_first).array)
    ratio = volumes.volume_from_object(of_other).array / volumes.volume_from_object(of_first).array
    of_modules = sensitivity(scanner.read_scanner(other), np.zeros((1, 3)))[0]
    assert ratio[1, 1, 1] == pytest.approx(of_modules.sum() / (of_modules.sum() - 0.75 * of_modules[0]), rel=1e-5)
    before = volumes.volume_from_object(of_first).array
    jobs.run(maps.remake_map_job(scene, of_first))  # while the other scanner is active
    assert np.array_equal(volumes.volume_from_object(of_first).array, before)


def test_maps_are_not_projected(imported):
    bpy.ops.mphdrr.add_map(quantity="modules", voxels=4)
    refused(bpy.ops.mphdrr.render_projections, "no volume of activity or mu in the scene", width=4, height=4)
    bpy.ops.mphdrr.add_derenzo(voxels=16, rod_diameters=(10, 8, 0, 0, 0, 0))
    assert bpy.ops.mphdrr.render_projections(width=4, height=4) == {"FINISHED"}


def test_a_maps_surface_is_at_a_value_of_the_windows_unit(imported):
    bpy.ops.mphdrr.add_map(quantity="sensitivity", voxels=12, within_roi=False)
    item = the_map()
    bpy.context.view_layer.objects.active = item
    settings = item.mphdrr_volume
    level = 0.7 * settings.maximum
    assert level > 100, "cps/MBq"
    assert bpy.ops.mphdrr.mesh_from_volume(level=level) == {"FINISHED"}
    mesh = bpy.data.meshes[f"{item.name} surface"]
    system = scanner.read_scanner(imported)
    places = np.array([vertex.co for vertex in mesh.vertices])
    values = 1e6 * sensitivity(system, places).sum(axis=1)
    assert np.median(values) == pytest.approx(level, rel=0.1)


@pytest.mark.parametrize("quantity", ["modules", "resolution", "completeness"])
def test_other_maps(imported, quantity):
    assert bpy.ops.mphdrr.add_map(quantity=quantity, voxels=4, side=20) == {"FINISHED"}
    low, high = {"modules": (16, 16), "resolution": (5, 20), "completeness": (0.8, 1.0)}[quantity]
    values = volumes.volume_from_object(the_map(quantity)).array
    assert values.min() >= low and values.max() <= high
