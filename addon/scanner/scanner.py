"""The scanner in the scene: built from a `Scanner` of any kind, found, read back and changed.

A scanner is a collection with a sub-collection for each ring; a module is a camera object (`Object.mphdrr_module`) whose
children are its parts: its collimator and its crystal.
"""

import itertools
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict

import bpy
import numpy as np
from mathutils import Quaternion

from ...core import InputError, PinholeSystem
from ...core.geometry.collimator import Construction
from ...core.geometry.scanner import Finding, Scanner
from ...core.scanner_kinds import SCANNERS
from ...core.workbook import ColumnMap, QuantityCells, SystemSource
from ..blender import ids, objects, storage
from ..blender.decimals import typed
from . import cameras, collimators, following, framing, pinholes
from .following import modules
from .module_values import changes, kind_of, off_aim, placed, read_modules, remember
from .scanner_parts import NewScanner, clear, losses

_DEFAULT = Construction()
_UNIT = 0.001  # m: a millimetre
_SMALLEST_REACH = 1.0  # mm, of a scanner without modules


def build_scanner(
    scene: bpy.types.Scene,
    system: Scanner,
    name: str = "",
    *,
    construction: Construction = _DEFAULT,
    shape: tuple[int, int] = (256, 256),
    replace: bool = False,
) -> bpy.types.Collection:
    """Put a scanner into the scene, in place of one of the same name; returns its collection.

    `construction` is that of pinholes' collimators. One with tilted modules does not keep them aimed.
    The scene's units become millimetres and its render resolution `shape`, pixels (n_v, n_u). The name is by default that of
    the workbook's file. The user's objects in the old scanner move to the scene's own collection. Raises InputError, and
    leaves the scene as it was, where a collimator cannot be built, or changes (`losses`) would be lost without `replace`.
    """
    name = name or default_name(system)
    old = find_scanner(scene, name)
    lost = losses(old) if old is not None and not replace else []
    if lost:
        raise InputError(
            f"scanner '{name}' has changed since it was imported ({'; '.join(lost)}): set replace=True to drop the changes"
        )
    new = NewScanner(system, system.parts(construction if isinstance(system, PinholeSystem) else None))
    hidden: set[int] = set()
    if old is None:
        collection = bpy.data.collections.new(name)
        scene.collection.children.link(collection)
    else:
        collection = old
        hidden = {o.mphdrr_module.number for o in modules(old) if not o.mphdrr_module.visible}
        clear(scene, old, new.cameras)
    new.name_and_link(collection)
    for number in hidden & set(new.cameras):
        set_visible(new.cameras[number], False)

    properties = collection.mphdrr_scanner
    properties.scanner_name, properties.kind, properties.design = name, system.kind, ""
    for setting, value in asdict(construction).items():
        setattr(properties, setting, value.upper() if isinstance(value, str) else value)
    properties.is_scanner = properties.parts_free = True
    if off_aim(collection, new.cameras.values()):
        properties.keep_aimed = False
    _write_source(properties, system)
    following.refresh(collection)

    first = next(iter(new.cameras.values()))
    render = scene.render
    render.resolution_y, render.resolution_x, render.resolution_percentage = *shape, 100
    fit_pixels(render, first)
    if old is None or not is_set_up(scene):
        set_up_scene(scene, collection)
    if scene.camera is None:
        scene.camera = first
    scene.mphdrr_geometry.scanner = collection  # and its first module becomes active
    return collection


def fit_pixels(render: bpy.types.RenderSettings, camera: bpy.types.Object) -> None:
    """Make a picture's pixels such that it shows a module's whole field, unstretched."""
    *_, width, height = map(abs, cameras.field_of(camera.data))
    longer = (width / render.resolution_x) / (height / render.resolution_y)  # how many times as wide as high a pixel is
    render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, longer), max(1.0, 1 / longer)


def remember_source(collection: bpy.types.Collection, system: Scanner) -> None:
    """Store `system`, which has the scanner's modules in their order, as what it was imported as: it has been saved."""
    with following.writing():
        remember(modules(collection), system)
    _write_source(collection.mphdrr_scanner, system)


def source(collection: bpy.types.Collection) -> SystemSource | None:
    """The workbook that the scanner was read from or last written to, with its column map, even if changed since."""
    values = json.loads(collection.mphdrr_scanner.source or "{}")
    if not values:
        return None
    columns = values.get("columns")  # files of earlier versions have none
    values["path"] = storage.absolute(collection.mphdrr_scanner.workbook or values["path"])  # it may be a copy by now
    values["numbers"] = tuple(values["numbers"])
    values["cells"] = tuple(QuantityCells(**{**cells, "rows": tuple(cells["rows"])}) for cells in values["cells"])
    values["columns"] = ColumnMap.from_toml(columns) if columns else None
    return SystemSource(**values)


def _write_source(properties: bpy.types.PropertyGroup, system: Scanner) -> None:
    values, known = {}, system.source
    if known is not None:
        columns = "" if known.columns is None else known.columns.to_toml()
        values = {**asdict(known), "path": str(known.path), "columns": columns}
    properties.source = json.dumps(values)
    properties.workbook, properties.sha256 = values.get("path", ""), values.get("sha256", "")
    properties.n_modules = len(system)
    properties.quick_ranges = json.dumps(quick_ranges(system))


def default_name(system: Scanner) -> str:
    """Name of a system's scanner when none is given: its workbook's, without the suffix; and its kind, unless pinhole."""
    name = ids.SCANNER if system.source is None else system.source.path.stem or ids.SCANNER
    return name if isinstance(system, PinholeSystem) else f"{name} {system.kind}"


def quick_ranges(system: Scanner) -> list[tuple[int, int]]:
    """Up to three ranges (first, last) of module numbers, each of half the rings: 1-40, 21-60, 41-80 of 4 x 20."""
    rings, numbers = system.rings(), np.asarray(system.numbers)
    n_rings = int(rings.max()) + 1
    width = max(1, n_rings // 2)
    ranges = []
    for start in sorted({0, (n_rings - width) // 2, n_rings - width}):
        inside = (rings >= start) & (rings < start + width)
        first, last = int(numbers[inside].min()), int(numbers[inside].max())
        if np.array_equal(inside, (numbers >= first) & (numbers <= last)):
            ranges.append((first, last))
    return ranges


def set_up_scene(scene: bpy.types.Scene, collection: bpy.types.Collection, rotation: Quaternion | None = None) -> None:
    """Set the scene's units for a scanner, and look at the whole of it, if given from the view's `rotation`."""
    units = scene.unit_settings
    units.system, units.scale_length, units.length_unit = "METRIC", _UNIT, "MILLIMETERS"
    reaches = [o.mphdrr_module.pinhole_distance + cameras.field_of(o.data)[2] for o in modules(collection)]
    framing.look(collection, max(reaches, default=_SMALLEST_REACH), rotation)


def is_set_up(scene: bpy.types.Scene) -> bool:
    """Whether the scene's units are millimetres."""
    units = scene.unit_settings
    return units.system == "METRIC" and abs(units.scale_length - _UNIT) < 1e-6 * _UNIT


def scanners(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """The scanners in the scene, of the kinds that are known."""
    found = [c for c in scene.collection.children_recursive if c.mphdrr_scanner.is_scanner]
    return [c for c in found if c.mphdrr_scanner.kind in SCANNERS]


def find_scanner(scene: bpy.types.Scene, name: str) -> bpy.types.Collection | None:
    """The scanner that was imported under that name, or whose collection is called so."""
    found = scanners(scene)
    by_name = [c for c in found if c.mphdrr_scanner.scanner_name == name] or [c for c in found if c.name == name]
    return by_name[0] if by_name else None


def free_name(scene: bpy.types.Scene, name: str) -> str:
    """A name that no scanner in the scene has: this one, or with a number."""
    names = itertools.chain([name], (f"{name} {number}" for number in itertools.count(2)))
    return next(each for each in names if find_scanner(scene, each) is None)


def scanner_of(scene: bpy.types.Scene, item: bpy.types.Object | None) -> bpy.types.Collection | None:
    """The scene's scanner that an object is in, the active one first; None for other objects."""
    if item is None:
        return None
    found = sorted(scanners(scene), key=lambda c: c != scene.mphdrr_geometry.scanner)
    return next((c for c in found if c.all_objects.get(item.name) == item), None)


def losses_of(scene: bpy.types.Scene, *names: str) -> list[str]:
    """The `losses` if the scene's scanners of these names were replaced."""
    found = filter(None, (find_scanner(scene, name) for name in names))
    return [line for collection in found for line in losses(collection)]


def active_scanner(scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """The scanner that the panels work on: the chosen one if it is in the scene, else the first; None without one."""
    found = scanners(scene)
    chosen = scene.mphdrr_geometry.scanner
    return chosen if chosen in found else next(iter(found), None)


def required_scanner(scene: bpy.types.Scene) -> bpy.types.Collection:
    """The scanner that the panels work on; raises `InputError` where there is none."""
    collection = active_scanner(scene)
    if collection is None:
        raise InputError("no scanner in the scene: import a workbook first")
    return collection


def module(collection: bpy.types.Collection, number: int) -> bpy.types.Object:
    """The camera object of a module; raises `InputError` where there is none."""
    for camera in modules(collection):
        if camera.mphdrr_module.number == number:
            return camera
    raise InputError(f"scanner '{collection.name}' has no module {number}")


def read_scanner(collection: bpy.types.Collection) -> Scanner:
    """The scanner as it stands in the scene now: the cameras' places and directions, and the values in their properties.

    Values that have not changed come back exactly, in float64. A pinhole's camera that does not look at the isocentre, to
    1e-4 rad, is that of a tilted module. The system has its source (the workbook) only while everything is as it was
    imported. What a script has moved just now is followed first: Blender has not yet called for it. Raises InputError for no
    modules, equal module numbers and impossible values.
    """
    following.refresh(collection)
    found = modules(collection)
    if not found:
        raise InputError(f"collection '{collection.name}' has no modules: import a geometry first")
    by_number: dict[int, bpy.types.Object] = {}
    for camera in found:
        other = by_number.setdefault(camera.mphdrr_module.number, camera)
        if other is not camera:
            raise InputError(
                f"'{other.name}' and '{camera.name}' both have module number {camera.mphdrr_module.number}: "
                f"press Tidy Modules in the Design panel, or delete one"
            )
    is_added = any(camera.mphdrr_module.added for camera in found)
    as_imported = (
        len(found) == collection.mphdrr_scanner.n_modules and not is_added and not any(map(any, changes(found)))
    )
    known = source(collection) if as_imported else None
    return read_modules(kind_of(collection), found, objects.world_matrices(found), known)


def sees_activity(collection: bpy.types.Collection | None) -> bool:
    """Whether a scanner, if there is one, is of those that see activity."""
    return collection is None or "activity" in kind_of(collection).takes


def own_pixels(collection: bpy.types.Collection) -> tuple[int, int] | None:
    """The pixels (n_v, n_u) of a scanner's images, of a kind that says them: those of its first module."""
    properties = collection.mphdrr_scanner
    says = "pixel_rows" in kind_of(collection).columns.fields
    return (properties.pixel_rows, properties.pixel_columns) if says else None


def read_pinholes(collection: bpy.types.Collection) -> PinholeSystem:
    """`read_scanner` of one that must have pinholes, or `InputError`."""
    system = read_scanner(collection)
    if not isinstance(system, PinholeSystem):
        raise InputError(f"scanner '{collection.name}' has no pinholes: it is of the kind {system.kind}")
    return system


def read_module(collection: bpy.types.Collection, camera: bpy.types.Object) -> Scanner:
    """One module of a scanner as it stands now, as a scanner of its own."""
    return read_modules(kind_of(collection), [camera], objects.world_matrix(camera)[None])


def check_geometry(collection: bpy.types.Collection) -> tuple[list[str], list[bpy.types.Object]]:
    """Check the scanner as its kind is checked, beside the scene's scanners of other kinds, and store the findings.

    Returns the findings, and the camera objects of the modules concerned.
    """
    system, found = read_scanner(collection), modules(collection)
    if isinstance(system, PinholeSystem):
        findings: Sequence[Finding] = pinholes.check(collection.mphdrr_scanner, system)
    else:
        others = [c for c in scanners(bpy.context.scene) if c.mphdrr_scanner.kind != system.kind]
        built = [pinholes.construction(c.mphdrr_scanner) for c in others if pinholes.has_pinholes(kind_of(c))]
        bore = typed(collection.mphdrr_scanner.bore) or None
        findings = system.findings([read_scanner(c) for c in others], next(iter(built), None), bore)
    with following.writing():
        collection.mphdrr_scanner.findings = json.dumps([str(finding) for finding in findings])
        for camera in found:
            own = (str(finding) for finding in findings if camera.mphdrr_module.number in finding.modules)
            camera.mphdrr_module.finding = "; ".join(own)
    return [str(finding) for finding in findings], [camera for camera in found if camera.mphdrr_module.finding]


def aim_modules(collection: bpy.types.Collection) -> list[int]:
    """Turn every camera that does not look at the isocentre; returns their modules' numbers."""
    found = modules(collection)
    places = placed(kind_of(collection), found, objects.world_matrices(found))
    turned = []
    for camera, matrix, aimed in zip(found, cameras.matrices_of(places.aims), places.aimed, strict=True):
        if not aimed:
            objects.set_world_matrix(camera, matrix)
            turned.append(camera.mphdrr_module.number)
    following.refresh(collection)
    return sorted(turned)


def set_visible(camera: bpy.types.Object, visible: bool) -> None:
    """Show or hide a module with its parts, in the viewport and in renders."""
    _set_hidden([camera, *(c for c in camera.children if c.mphdrr_module.part in collimators.PARTS)], not visible)


def show_modules(collection: bpy.types.Collection, first: int, last: int, mode: str = "ONLY") -> int:
    """Show modules by their numbers, first to last; returns how many are visible now.

    `mode` is ``"SHOW"`` or ``"HIDE"``, which leave the other modules, ``"ONLY"``, or ``"ALL"``, which needs no range.
    """
    found = modules(collection)
    inside = {o for o in found if mode == "ALL" or first <= o.mphdrr_module.number <= last}
    if not inside:
        numbers = [o.mphdrr_module.number for o in found] or [0]
        raise InputError(
            f"no module between {first} and {last}: '{collection.name}' has {min(numbers)} to {max(numbers)}"
        )
    for camera, parts in following.parts_of(collection, found).items():
        if camera in inside or mode == "ONLY":
            _set_hidden([camera, *parts], mode == "HIDE" or camera not in inside)
    return sum(not camera.hide_viewport for camera in found)


def _set_hidden(items: Iterable[bpy.types.Object], hide: bool) -> None:
    for item in items:
        objects.change(item, hide_viewport=hide, hide_render=hide)
