"""The scanner in the scene: built from a `Scanner` of any kind, found, read back and changed.

A scanner is a collection with a sub-collection for each ring; a module is a camera object (`Object.mphdrr_module`) whose
children are its parts: its collimator and its crystal.
"""

import itertools
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from operator import itemgetter
from typing import Any

import bpy
import numpy as np
from mathutils import Quaternion

from ...core import InputError, PinholeSystem
from ...core.arrays import ArrayLike, Integers
from ...core.geometry.collimator import Construction
from ...core.geometry.scanner import Finding, Scanner
from ...core.geometry.system import chosen_indices
from ...core.scanner_kinds import SCANNERS
from ...core.workbook import ColumnMap, QuantityCells, SystemSource
from ..blender import ids, objects, storage
from ..blender.decimals import typed
from . import cameras, collimators, following, framing, pinholes
from .following import modules
from .module_values import changed_modules, kind_of, read_modules, read_placement, store_exact_values, unaimed_numbers
from .scanner_parts import NewScanner, clear, losses

_DEFAULT = Construction()
_MILLIMETER = 0.001  # m
_MIN_REACH = 1.0  # mm, radius shown of a scanner without modules


def build_scanner(
    scene: bpy.types.Scene,
    system: Scanner,
    name: str = "",
    *,
    construction: Construction = _DEFAULT,
    shape: tuple[int, int] = (256, 256),
    replace: bool = False,
) -> bpy.types.Collection:
    """Put a scanner into the scene, in place of one of the same name, and return its collection.

    `construction` is that of pinholes' collimators. A scanner with tilted modules does not keep them aimed. The scene's
    units become millimetres and its render resolution `shape`, pixels (n_v, n_u). The name is by default that of the
    workbook's file. The user's objects in the old scanner move to the scene's own collection. Raises InputError, and leaves
    the scene as it was, where a collimator cannot be built, or changes (`losses`) would be lost without `replace`.
    """
    name = name or default_name(system)
    old = find_scanner(scene, name)
    lost = losses(old) if old is not None and not replace else []
    if lost:
        raise InputError(
            f"scanner '{name}' has changed since it was imported ({'; '.join(lost)}): set replace=True to drop the changes"
        )
    new_scanner = NewScanner(system, system.parts(construction))
    hidden_numbers: set[int] = set()
    if old is None:
        collection = bpy.data.collections.new(name)
        scene.collection.children.link(collection)
    else:
        collection = old
        hidden_numbers = {o.mphdrr_module.number for o in modules(old) if not o.mphdrr_module.visible}
        clear(scene, old, new_scanner.cameras)
    new_scanner.name_and_link(collection)
    for number in hidden_numbers & set(new_scanner.cameras):
        set_visible(new_scanner.cameras[number], False)

    properties = collection.mphdrr_scanner
    properties.scanner_name, properties.kind, properties.design = name, system.kind, ""
    for setting, value in asdict(construction).items():
        setattr(properties, setting, value.upper() if isinstance(value, str) else value)
    properties.is_scanner = properties.parts_free = True
    if unaimed_numbers(collection, new_scanner.cameras.values()):
        properties.keep_aimed = False
    _write_source(properties, system)
    following.refresh(collection)

    first = next(iter(new_scanner.cameras.values()))
    render = scene.render
    render.resolution_y, render.resolution_x, render.resolution_percentage = *shape, 100
    fit_pixels(render, first)
    if old is None or not is_set_up(scene):
        set_up_scene(scene, collection)
    if scene.camera is None:
        scene.camera = first
    scene.mphdrr_geometry.scanner = collection  # makes its first module active
    return collection


def fit_pixels(render: bpy.types.RenderSettings, camera: bpy.types.Object) -> None:
    """Set a picture's pixel aspect so that it shows a module's whole field, unstretched."""
    *_, width, height = map(abs, cameras.field_of(camera.data))
    aspect = (width / render.resolution_x) / (height / render.resolution_y)  # width of a pixel over its height
    render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, aspect), max(1.0, 1 / aspect)


def store_saved_state(collection: bpy.types.Collection, system: Scanner) -> None:
    """Store `system`, with the scanner's modules in their order, as the saved state of the scanner."""
    with following.writing():
        store_exact_values(modules(collection), system)
    _write_source(collection.mphdrr_scanner, system)


def source(collection: bpy.types.Collection) -> SystemSource | None:
    """Return the workbook that the scanner was read from or last written to, with its column map, even if changed since."""
    values = json.loads(collection.mphdrr_scanner.source or "{}")
    if not values:
        return None
    columns = values.get("columns")  # absent in files of earlier versions
    values["path"] = storage.absolute(collection.mphdrr_scanner.workbook or values["path"])  # may be a copy
    values["numbers"] = tuple(values["numbers"])
    values["cells"] = tuple(QuantityCells(**{**cells, "rows": tuple(cells["rows"])}) for cells in values["cells"])
    values["columns"] = ColumnMap.from_toml(columns) if columns else None
    return SystemSource(**values)


def _write_source(properties: bpy.types.PropertyGroup, system: Scanner) -> None:
    """Store a system's workbook, number of modules and quick ranges in the scanner's properties."""
    values, source = {}, system.source
    if source is not None:
        columns = "" if source.columns is None else source.columns.to_toml()
        values = {**asdict(source), "path": str(source.path), "columns": columns}
    properties.source = json.dumps(values)
    properties.workbook, properties.sha256 = values.get("path", ""), values.get("sha256", "")
    properties.n_modules = len(system)


def default_name(system: Scanner) -> str:
    """Return the name for a system's scanner: its workbook's without the suffix, followed by a kind other than pinhole."""
    name = ids.SCANNER if system.source is None else system.source.path.stem or ids.SCANNER
    return name if isinstance(system, PinholeSystem) else f"{name} {system.kind}"


def numbers_text(numbers: Iterable[int], chosen: Iterable[bool]) -> str:
    """Return the chosen ones of module numbers as text, such as "1-40, 45"."""
    pairs = sorted(zip(numbers, chosen, strict=True))
    runs = ([number for number, _ in run] for is_chosen, run in itertools.groupby(pairs, itemgetter(1)) if is_chosen)
    return ", ".join("-".join(dict.fromkeys(map(str, (run[0], run[-1])))) for run in runs)


def quick_ranges(numbers: ArrayLike, rings: Integers) -> list[str]:
    """Return up to three texts of module numbers (M,), each of half the rings: 1-40, 21-60, 41-80 of 4 x 20."""
    n_rings = int(rings.max(initial=0)) + 1
    width = max(1, n_rings // 2)
    starts = sorted({0, (n_rings - width) // 2, n_rings - width})
    return [numbers_text(np.asarray(numbers).tolist(), (rings >= s) & (rings < s + width)) for s in starts]


def set_up_scene(
    scene: bpy.types.Scene, collection: bpy.types.Collection, rotation: Quaternion | None = None, reach: float = 0.0
) -> None:
    """Set the scene's units for a scanner, and turn the views to it as `framing.frame_scanner` does.

    `rotation` is the direction from which it is seen, `reach` the radius shown, mm, by default all of it.
    """
    units = scene.unit_settings
    units.system, units.scale_length, units.length_unit = "METRIC", _MILLIMETER, "MILLIMETERS"
    reaches = [o.mphdrr_module.pinhole_distance + cameras.field_of(o.data)[2] for o in modules(collection)]
    framing.frame_scanner(collection, max(reaches, default=_MIN_REACH), rotation, reach)


def is_set_up(scene: bpy.types.Scene) -> bool:
    """Return whether the scene's units are millimetres."""
    units = scene.unit_settings
    return units.system == "METRIC" and abs(units.scale_length - _MILLIMETER) < 1e-6 * _MILLIMETER


def scanners(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """Return the scene's scanners of known kinds."""
    collections = [c for c in scene.collection.children_recursive if c.mphdrr_scanner.is_scanner]
    return [c for c in collections if c.mphdrr_scanner.kind in SCANNERS]


def find_scanner(scene: bpy.types.Scene, name: str) -> bpy.types.Collection | None:
    """Return the scanner that was imported under that name, or whose collection has it; None if there is none."""
    candidates = scanners(scene)
    matches = [c for c in candidates if c.mphdrr_scanner.scanner_name == name]
    return next(iter(matches or [c for c in candidates if c.name == name]), None)


def free_name(scene: bpy.types.Scene, name: str) -> str:
    """Return a name that no scanner in the scene has: `name`, or `name` with a number."""
    names = itertools.chain([name], (f"{name} {number}" for number in itertools.count(2)))
    return next(candidate for candidate in names if find_scanner(scene, candidate) is None)


def scanner_of(scene: bpy.types.Scene, item: bpy.types.Object | None) -> bpy.types.Collection | None:
    """Return the scene's scanner that an object is in, the active one first; None for other objects."""
    if item is None:
        return None
    collections = sorted(scanners(scene), key=lambda c: c != scene.mphdrr_geometry.scanner)
    return next((c for c in collections if c.all_objects.get(item.name) == item), None)


def losses_of(scene: bpy.types.Scene, *names: str) -> list[str]:
    """Return the changes that would be lost if the scene's scanners of these names were replaced (`losses`)."""
    collections = filter(None, (find_scanner(scene, name) for name in names))
    return [line for collection in collections for line in losses(collection)]


def active_scanner(scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """Return the scanner that the panels work on: the chosen one if it is in the scene, else the first; None without one."""
    collections = scanners(scene)
    chosen = scene.mphdrr_geometry.scanner
    return chosen if chosen in collections else next(iter(collections), None)


def required_scanner(scene: bpy.types.Scene) -> bpy.types.Collection:
    """Return the scanner that the panels work on; raise `InputError` where there is none."""
    if (collection := active_scanner(scene)) is None:
        raise InputError("no scanner in the scene: import a workbook first")
    return collection


def module(collection: bpy.types.Collection, number: int) -> bpy.types.Object:
    """Return the camera object of a module by its number; raise `InputError` where there is none."""
    for camera in modules(collection):
        if camera.mphdrr_module.number == number:
            return camera
    raise InputError(f"scanner '{collection.name}' has no module {number}")


def read_scanner(collection: bpy.types.Collection) -> Scanner:
    """Return the scanner as it stands in the scene now, from the cameras' positions and the modules' properties.

    Unchanged values come back exactly, in float64. A pinhole's camera that does not look at the isocentre, to 1e-4 rad, is
    that of a tilted module. The system has its source (the workbook) only while everything is as it was imported. Modules
    that a script has just moved are refreshed first: Blender has not yet called the handlers. Raises InputError for no
    modules, equal module numbers and impossible values.
    """
    cameras_ = modules(collection)
    objects.require_evaluated(cameras_)
    following.refresh(collection)
    if not cameras_:
        raise InputError(f"collection '{collection.name}' has no modules: import a geometry first")
    by_number: dict[int, bpy.types.Object] = {}
    for camera in cameras_:
        if (first := by_number.setdefault(camera.mphdrr_module.number, camera)) is not camera:
            number, advice = camera.mphdrr_module.number, "press Tidy Modules in the Design panel, or delete one"
            raise InputError(f"'{first.name}' and '{camera.name}' both have module number {number}: {advice}")
    is_added = any(camera.mphdrr_module.added for camera in cameras_)
    is_complete = len(cameras_) == collection.mphdrr_scanner.n_modules and not is_added
    as_imported = is_complete and not any(map(any, changed_modules(cameras_)))
    source_ = source(collection) if as_imported else None
    return read_modules(kind_of(collection), cameras_, objects.world_matrices(cameras_), source_)


def sees_activity(collection: bpy.types.Collection | None) -> bool:
    """Return whether a scanner images activity; True without a scanner."""
    return collection is None or "activity" in kind_of(collection).takes


def fixed_pixels(collection: bpy.types.Collection) -> tuple[int, int] | None:
    """Return the pixels (n_v, n_u) of a scanner's images, those of its first module; None for kinds that leave them open."""
    properties = collection.mphdrr_scanner
    has_pixels = "pixel_rows" in kind_of(collection).columns.fields
    return (properties.pixel_rows, properties.pixel_columns) if has_pixels else None


def read_pinholes(collection: bpy.types.Collection) -> PinholeSystem:
    """Return a scanner that has pinholes as it stands in the scene now; raise `InputError` for any other kind."""
    system = read_scanner(collection)
    if not isinstance(system, PinholeSystem):
        raise InputError(f"scanner '{collection.name}' has no pinholes: it is of the kind {system.kind}")
    return system


def read_module(collection: bpy.types.Collection, camera: bpy.types.Object) -> Scanner:
    """Return one module of a scanner as it stands now, as a scanner of its own."""
    return read_modules(kind_of(collection), [camera], objects.world_matrix(camera)[None])


def check_geometry(collection: bpy.types.Collection) -> tuple[list[str], list[bpy.types.Object]]:
    """Check the scanner as its kind is checked, beside the scene's scanners of other kinds, and store the findings.

    Return the findings as texts, and the camera objects of the modules concerned.
    """
    system, cameras_ = read_scanner(collection), modules(collection)
    if isinstance(system, PinholeSystem):
        findings: Sequence[Finding] = pinholes.find_problems(collection.mphdrr_scanner, system)
    else:
        other_scanners = [c for c in scanners(bpy.context.scene) if c.mphdrr_scanner.kind != system.kind]
        designs = [pinholes.construction(c.mphdrr_scanner) for c in other_scanners if pinholes.has_pinholes(kind_of(c))]
        bore = typed(collection.mphdrr_scanner.bore) or None
        findings = system.findings([read_scanner(c) for c in other_scanners], next(iter(designs), None), bore)
    with following.writing():
        collection.mphdrr_scanner.findings = json.dumps([str(finding) for finding in findings])
        for camera in cameras_:
            texts = (str(finding) for finding in findings if camera.mphdrr_module.number in finding.modules)
            camera.mphdrr_module.finding = "; ".join(texts)
    return [str(finding) for finding in findings], [camera for camera in cameras_ if camera.mphdrr_module.finding]


def aim_modules(collection: bpy.types.Collection) -> list[int]:
    """Turn every camera that does not look at the isocentre, and return the numbers of their modules."""
    cameras_ = modules(collection)
    placement = read_placement(kind_of(collection), cameras_, objects.world_matrices(cameras_))
    turned = []
    for camera, pose, is_aimed in zip(cameras_, placement.aims, placement.aimed, strict=True):
        if not is_aimed:
            following.aim_camera(camera, pose)
            turned.append(camera.mphdrr_module.number)
    following.refresh(collection)
    return sorted(turned)


def set_visible(camera: bpy.types.Object, visible: bool) -> None:
    """Show or hide a module with its parts, in the viewport and in renders."""
    _set_hidden([camera, *(c for c in camera.children if c.mphdrr_module.part in collimators.PARTS)], not visible)


def _active_modules(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return the modules of the active scanner, if there is one."""
    collection = active_scanner(scene)
    return modules(collection) if collection else []


def suggested_ranges(settings: Any, context: bpy.types.Context, text: str) -> list[str]:
    """Return what a text field of module numbers suggests (`quick_ranges`)."""
    values = [(o.mphdrr_module.number, o.mphdrr_module.ring) for o in _active_modules(context.scene)]
    return quick_ranges(*np.reshape(values, (-1, 2)).astype(int).T)


def visible_modules(settings: bpy.types.PropertyGroup) -> str:
    """Return the numbers of the visible modules of the scene's scanner, such as "1-40, 45"; "" if all are visible."""
    cameras_ = _active_modules(settings.id_data)
    are_visible = [not camera.hide_viewport for camera in cameras_]
    numbers = [camera.mphdrr_module.number for camera in cameras_]
    return "" if all(are_visible) else numbers_text(numbers, are_visible) or "none"


def show_visible_modules(settings: bpy.types.PropertyGroup, text: str) -> None:
    """Show only the modules of the scene's scanner that a text lists; keep the reason in `settings` if it lists none."""
    settings.visible_problem = ""
    try:
        show_modules(required_scanner(settings.id_data), text)
    except InputError as error:
        settings.visible_problem = str(error)


def show_modules(collection: bpy.types.Collection, text: str = "", mode: str = "ONLY") -> int:
    """Show the modules whose numbers a text lists, such as "1-40, 45", and return how many are visible now; "": all.

    `mode` is ``"SHOW"`` or ``"HIDE"``, which leave the other modules, ``"ONLY"``, or ``"ALL"``, which needs no text.
    """
    cameras_ = modules(collection)
    numbers = np.array([camera.mphdrr_module.number for camera in cameras_] or [0])
    chosen_numbers = numbers[chosen_indices(numbers, text if text and mode != "ALL" else "-", "modules")]
    chosen = {camera for camera in cameras_ if camera.mphdrr_module.number in chosen_numbers}
    for camera, parts in following.parts_of(collection, cameras_).items():
        if camera in chosen or mode == "ONLY":
            _set_hidden([camera, *parts], mode == "HIDE" or camera not in chosen)
    return sum(not camera.hide_viewport for camera in cameras_)


def _set_hidden(items: Iterable[bpy.types.Object], hide: bool) -> None:
    """Show or hide objects in the viewport and in renders."""
    for item in items:
        objects.change(item, hide_viewport=hide, hide_render=hide)
