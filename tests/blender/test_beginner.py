"""What somebody sees who opens the tab for the first time: how much, whether it is explained, and whether it fits."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from typing import Any

import blf
import bpy
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon import example, next_step, registration
from mphdrr.addon.blender import storage
from mphdrr.addon.pictures import planes
from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import slices, volumes

from .conftest import module, update

PANELS = [cls for cls in registration.CLASSES if issubclass(cls, bpy.types.Panel)]
WIDTH = 236  # pixels for a panel's contents, in a sidebar of Blender's default width
LABELS = 0.4  # share of settings' names, where they have a column of their own
BESIDE = {"BOOLEAN": 20, "INT": 40, "FLOAT": 40}  # pixels beside a name in the same button: a box, or a number
LETTERS, ICON, MARGIN = 11, 20, 4  # pixels
BUTTON = 200  # pixels that whatever has a text asks for, however long that is, where it fills its place


class Settings:
    """Stand-in for the settings of an operator's button; those that do not exist cannot be set."""

    def __init__(self, known: Any) -> None:
        vars(self).update(known=known)

    def __setattr__(self, name: str, value: Any) -> None:
        assert name in self.known.properties, f"{self.known.identifier}: {name}"


class Layout:
    """Stand-in for Blender's layout: it remembers what is drawn, and shares out the width as Blender does."""

    def __init__(self, kind: str = "column", factor: float = 0.0, **settings: Any) -> None:
        self.kind, self.factor, self.items = kind, factor, []
        self.use_property_split, self.alignment = False, "EXPAND"
        vars(self).update(settings)

    def _inside(self, kind: str, factor: float = 0.0) -> Layout:
        self.items.append(Layout(kind, factor, use_property_split=self.use_property_split))
        return self.items[-1]

    def column(self, heading: str = "", **_: Any) -> Layout:
        return self._inside("column")

    box = column

    def row(self, heading: str = "", **_: Any) -> Layout:
        if not heading:
            return self._inside("row")
        beside = self._inside("row", LABELS)
        beside._leaf("label", heading)
        beside.use_property_split = False
        return beside._inside("row")

    def split(self, factor: float = 0.0, **_: Any) -> Layout:
        return self._inside("row", factor)

    def grid_flow(self, columns: int, **_: Any) -> Layout:
        return self._inside("grid", columns)

    def _leaf(self, what: str, text: str, icon: str = "NONE", **more: Any) -> None:
        self.items.append({"what": what, "text": text, "icon": icon not in ("NONE", ""), **more})

    def label(self, text: str = "", icon: str = "NONE", **_: Any) -> None:
        self._leaf("label", text, icon)

    def operator(self, idname: str, text: str | None = None, icon: str = "NONE", **_: Any) -> Any:
        group, name = idname.split(".")
        known = getattr(getattr(bpy.ops, group), name).get_rna_type()
        said = known.name if text is None else text
        self._leaf("button", said, icon, explained=bool(known.description.strip()), name=idname)
        return Settings(known)

    def operator_menu_enum(self, idname: str, setting: str, **options: Any) -> None:
        setattr(self.operator(idname, **options), setting, None)

    def menu(self, name: str, text: str = "", icon: str = "NONE") -> None:
        self._leaf("button", text, icon, explained=True, name=name)

    def popover(self, name: str, text: str | None = None, icon: str = "NONE") -> None:
        known = getattr(bpy.types, name)
        said = known.bl_label if text is None else text
        self._leaf("button", said, icon, explained=bool(known.bl_description), name=name, more=ICON)

    def prop(
        self, owner: Any, name: str, text: str | None = None, icon: str = "NONE", expand=False, toggle=False, **_: Any
    ) -> None:
        known = owner.bl_rna.properties[name]
        said = known.name if text is None else text
        is_split = self.use_property_split and said and known.type != "BOOLEAN"
        if expand:
            row = self.row()
            for item in known.enum_items:
                row._leaf("property", item.name, explained=bool(known.description), name=name)
        else:
            what = "name" if is_split else "property"
            more = 0 if is_split or not said or toggle else BESIDE.get(known.type, 0)
            self._leaf(what, said, icon, explained=bool(known.description.strip()), name=name, more=more)

    def prop_enum(self, owner: Any, name: str, value: str) -> None:
        known = owner.bl_rna.properties[name]
        self._leaf("property", known.enum_items[value].name, explained=bool(known.description), name=name)

    def template_list(self, *_: Any, **__: Any) -> None:
        self._leaf("list", "")

    def __getattr__(self, name: str) -> Any:
        if name in ("separator", "template_icon", "progress", "context_pointer_set"):
            return lambda *_, **__: None
        raise AttributeError(name)

    def leaves(self) -> Iterator[dict[str, Any]]:
        """Yield all that is drawn."""
        for item in self.items:
            yield from item.leaves() if isinstance(item, Layout) else [item]

    def wanted(self) -> float:
        """Return the width that the layout asks for."""
        widths = self._widths() or [0.0]
        return sum(widths) if self.kind == "row" else max(widths)

    def _widths(self) -> list[float]:
        """Return the widths that the items ask for."""
        asked = (lambda item: BUTTON if item["text"] else ICON) if self.alignment == "EXPAND" else _needed
        return [item.wanted() if isinstance(item, Layout) else asked(item) for item in self.items]

    def cut(self, width: float) -> Iterator[str]:
        """Yield the texts for which there is not enough room."""
        wanted = self._widths()
        for k, (item, asked) in enumerate(zip(self.items, wanted, strict=True)):
            if self.kind == "grid":
                own = width / self.factor
            elif self.kind == "column":
                own = width
            elif self.factor:
                own = width * (self.factor if k == 0 else (1 - self.factor) / max(1, len(self.items) - 1))
            else:
                own = width * asked / sum(wanted)
            if isinstance(item, Layout):
                yield from item.cut(own)
            elif item["text"] and _needed(item) > own * (LABELS if item["what"] == "name" else 1):
                yield f"{item['text']} ({_needed(item):.0f} of {own:.0f})"


def _needed(item: dict[str, Any]) -> float:
    return blf.dimensions(0, item["text"])[0] + MARGIN + ICON * item["icon"] + item.get("more", 0)


def is_popover(cls: type) -> bool:
    return "INSTANCED" in getattr(cls, "bl_options", ())


def is_top(cls: type) -> bool:
    return not hasattr(cls, "bl_parent_id") and not is_popover(cls)


def drawn(is_open: bool = False, space: str = "VIEW_3D") -> dict[str, Layout]:
    """Return the panels that an editor draws, by their classes' names: those in sight at first, or all of them, open."""
    blf.size(0, LETTERS)
    seen: dict[str, Layout] = {}
    panels = [cls for cls in PANELS if cls.bl_space_type == space]
    for cls in sorted(panels, key=lambda cls: (is_popover(cls), hasattr(cls, "bl_parent_id"))):
        parent = getattr(cls, "bl_parent_id", None)
        is_hidden = is_popover(cls) and cls.__name__ not in names(seen, "button")
        is_closed = parent and not (parent in seen and seen[parent].is_open)
        if is_hidden or is_closed or (hasattr(cls, "poll") and not cls.poll(bpy.context)):
            continue
        seen[cls.__name__] = layout = Layout(is_open=is_open or "DEFAULT_CLOSED" not in getattr(cls, "bl_options", ()))
        if layout.is_open:
            panel = type("Drawn", (), {"layout": layout})()
            panel.draw_volume = functools.partial(getattr(cls, "draw_volume", len), panel)
            panel.draw_scanner = functools.partial(getattr(cls, "draw_scanner", len), panel)
            cls.draw(panel, bpy.context)
    return seen


def names(seen: dict[str, Layout], *what: str) -> list[str]:
    leaves = [leaf for layout in seen.values() for leaf in layout.leaves()]
    return [leaf["name"] for leaf in leaves if leaf["what"] in what and "name" in leaf]


def check(seen: dict[str, Layout]) -> None:
    """Check that everything is explained, and no text is cut."""
    leaves = [leaf for layout in seen.values() for leaf in layout.leaves()]
    assert not [leaf for leaf in leaves if not leaf.get("explained", True)]
    assert not {name: cut for name, layout in seen.items() if (cut := list(layout.cut(WIDTH)))}


def test_an_empty_tab_shows_three_buttons(scene):
    seen = drawn()
    assert list(seen) == ["MPHDRR_PT_next_step"]
    assert names(seen, "button") == ["mphdrr.load_example", "mphdrr.load_example", "mphdrr.import_geometry"]
    assert names(drawn(is_open=True), "property", "name") == []
    check(seen)


@pytest.fixture
def worked(scene, dc_spect) -> Any:
    """Return a scene with a scanner, a phantom, a run and its reconstruction."""
    scanner.build_scanner(scene, dc_spect[:8])
    bpy.ops.mphdrr.add_derenzo(voxels=12)
    bpy.ops.mphdrr.render_projections(width=8, height=8)
    bpy.ops.mphdrr.reconstruct(method="SIRT", voxels=12, iterations=2)
    return scene


def test_a_beginner_sees_little(worked):
    seen = drawn()
    assert len(seen) <= 8
    tops = {name: layout for name, layout in drawn(is_open=True).items() if is_top(getattr(bpy.types, name))}
    for shown in (seen, *({name: layout} for name, layout in tops.items())):
        assert len(names(shown, "button")) <= 14 and len(names(shown, "property", "name")) <= 12, list(shown)
    check(seen)


@pytest.mark.parametrize("model", ["TRANSMISSION", "EMISSION"])
def test_everything_is_explained_and_fits(worked, model):
    settings, camera = worked.mphdrr_projections, scanner.module(scanner.active_scanner(worked), 3)
    worked.mphdrr_reconstruction.record = ""  # scores are of all lengths
    for hole, active in itertools.product(("AUTO", "RAYS"), (camera, worked.objects["Derenzo"])):
        settings.model, settings.hole = model, hole
        bpy.context.view_layer.objects.active = active
        check(drawn(is_open=True))


def press() -> str:
    """Press the button that the tab proposes."""
    step = next_step.next_step(bpy.context)
    group, name = step.operator.split(".")
    with bpy.context.temp_override(**({} if step.item is None else {"object": step.item})):
        assert getattr(getattr(bpy.ops, group), name)("INVOKE_DEFAULT", **step.settings) == {"FINISHED"}
    return step.text


def test_what_is_proposed_leads_to_a_score(scene, imported):
    settings, reconstruction = scene.mphdrr_projections, scene.mphdrr_reconstruction
    settings.width = settings.height = reconstruction.voxels = 12
    reconstruction.method = "SIRT"  # without a window, what is chosen by the run is the default
    assert [press(), press(), press()] == ["Add Phantom", "Render Projections", "Reconstruct"]
    assert "NRMSE" in {name for name, _ in reconstruction.details["scores"]}
    assert next_step.next_step(bpy.context).text == "Export Dataset"
    scanner.module(scanner.active_scanner(scene), 3).location.x += 1.0
    update()
    run = next(stage for stage in next_step.work_stages(bpy.context) if stage.name == "Run")
    assert run.is_stale and run.note == "Module 03 moved"
    check(drawn())
    assert [press(), press()] == ["Render Again", "Reconstruct"]
    scene.mphdrr_events.recipe = "//heart.toml"
    assert scene.mphdrr_events.folder == "//heart-events"
    assert next_step.next_step(bpy.context).text == "Make Event Set"


def test_ct_attenuation_spect_and_dose_are_six_clicks(scene, monkeypatch):
    monkeypatch.setattr(example, "_VOXELS", 32)
    monkeypatch.setitem(example._RING, "shape", (24, 32))
    assert bpy.ops.mphdrr.load_example(example="XRAY") == {"FINISHED"}
    update()
    assert not bpy.context.selected_objects and not any(o.visible_get() for o in scene.objects if o.type == "LIGHT")
    assert [o.name for o in planes.planes(scene) if o.visible_get()] == ["Projection 18"], (
        "on the one panel that is shown"
    )
    settings, reconstruction = scene.mphdrr_projections, scene.mphdrr_reconstruction
    ct_run = mph.read_run(storage.absolute(settings.run_file))
    assert settings.model == "SPECTRAL" and settings.noise and len(ct_run.system) == 24
    settings.width = settings.height = 16
    reconstruction.voxels, reconstruction.spacing, reconstruction.iterations = 28, 16.0, 3
    assert [press(), press()] == ["Reconstruct", "Use CT for SPECT"]
    ct = reconstruction.mu
    assert volumes.quantity_of(ct) == "hu"
    assert (settings.model, settings.isotope, settings.volume.name) == ("EMISSION", "Tc-99m", "Cardiac Torso")
    reconstruction.method = "OSEM"  # without a window, what is chosen by the run is the default
    assert press() == "Render Projections"
    check(drawn())
    assert press() == "Reconstruct"
    assert press() == "Dose Map" and volumes.quantity_of(bpy.context.object) == "dose_rate"
    assert next_step.next_step(bpy.context).text == "Export Dataset"
    # By hand: attenuated by the torso, reconstructed with the CT.
    run = mph.read_run(storage.absolute(settings.run_file))
    assert run.recipe["attenuation.object"] == "Cardiac Torso mu"
    chosen = {"voxels": 28, "spacing": 16.0, "iterations": 3, "center": (35.0, -30.0, -30.0)}
    recipe = mph.Recipe({f"reconstruction.{key}": value for key, value in chosen.items()})
    expected = mph.reconstruct_run(run, recipe, volumes.volume_from_object(ct)).volume.array
    found = volumes.volume_from_object(reconstruction.volume).array
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4 * expected.max())
    # By script: the same radiographs.
    system, body = ct_run.system, volumes.volume_from_object(scene.objects["Cardiac Torso mu"])
    by_script = mph.Recipe({"model.kind": "spectral", "volume.energy": 140.5, "noise.seed": 1})
    (again,) = mph.run_recipe(by_script, system, body)
    np.testing.assert_array_equal(again.projections, ct_run.projections)


def test_a_number_that_is_not_given_is_auto(scene):
    settings = scene.mphdrr_projections
    assert settings.threads_unset and settings.window_unset
    settings.threads_unset = settings.window_unset = False
    assert settings.threads == 6 and tuple(settings.window) == (100, 200)
    settings.threads_unset = True
    assert settings.threads == 0 and not settings.window_unset


def test_the_numbers_of_the_only_volume_are_shown_whatever_is_selected(scene, ring_system):
    camera = scanner.module(scanner.build_scanner(scene, ring_system), 1)
    bpy.ops.mphdrr.add_points(voxels=8)
    item = bpy.context.object
    bpy.context.view_layer.objects.active = camera
    assert volumes.panel_volume(bpy.context) == item
    assert {"MPHDRR_PT_look", "MPHDRR_PT_phantom_settings"} <= drawn(is_open=True).keys()
    with bpy.context.temp_override(object=item):  # as the panel's buttons have it
        bpy.ops.mphdrr.add_slices()
    planes = slices.planes_of(item)
    item.hide_set(True)
    update()
    assert not any(plane.visible_get() for plane in planes)
    item.hide_set(False)
    update()
    assert all(plane.visible_get() for plane in planes)


def test_panels_of_every_editor_draw_settings_and_buttons_that_exist(scene, ring_system):
    def draw_all() -> int:
        return sum(len(drawn(True, space)) for space in {cls.bl_space_type for cls in PANELS})

    without = draw_all()
    collection = scanner.build_scanner(scene, ring_system)
    bpy.ops.mphdrr.check_geometry()
    bpy.context.view_layer.objects.active = module(3)
    assert draw_all() > without
    collection.objects.link(module(2).copy())
    update()
    module(1).mphdrr_module.pinhole_diameter = 500.0
    collection.mphdrr_scanner.findings = '["a finding that is too long for one line of the sidebar"]'
    draw_all()
    for add in (bpy.ops.mphdrr.add_derenzo, bpy.ops.mphdrr.add_torso):
        assert add(voxels=12) == {"FINISHED"}
        draw_all()


def test_labels_of_the_projections_fit_beside_their_fields(scene):
    """At the default width a label has 85 pixels, with letters of 11; checkboxes have theirs on the right."""
    blf.size(0, LETTERS)
    properties = scene.mphdrr_projections.bl_rna.properties
    labels = {p.name for p in properties if p.type != "BOOLEAN" and not p.is_hidden}
    assert len(labels) > 20
    assert {name for name in labels if blf.dimensions(0, name)[0] > 85} == set()
