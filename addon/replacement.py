"""What replacing a scanner would lose, and removing the old one while keeping everything that is the user's."""

from __future__ import annotations

from collections.abc import Sequence

import bpy

from . import cameras
from .module_values import is_edited, is_moved, off_aim


def losses(collection: bpy.types.Collection) -> list[str]:
    """The changes that replacing the scanner would undo, a phrase each; empty if it is as it was imported."""
    parts, others = parts_and_others(collection)
    found = [o for o in parts if o.mphdrr_module.is_module]
    lost = []
    for what, is_lost in (
        ("moved or turned", lambda o: is_moved(o) or off_aim([o])),
        ("with changed numbers", is_edited),
        ("added", lambda o: o.mphdrr_module.added),
        ("with animation or constraints", lambda o: o.animation_data is not None or len(o.constraints)),
    ):
        numbers = [o.mphdrr_module.number for o in found if is_lost(o)]
        if numbers:
            lost.append(f"{modules_text(numbers)} {what}")
    gone = collection.mphdrr_scanner.n_modules - sum(not o.mphdrr_module.added for o in found)
    if gone > 0:
        lost.append(f"{gone} module{'s' * (gone > 1)} deleted or moved out")
    names = [o.name for o in others] + [c.name for c in _own_collections(collection)]
    if names:
        lost.append(f"yours, which will move to the scene's collection: {_listed(names)}")
    return lost


def clear(scene: bpy.types.Scene, collection: bpy.types.Collection, replacements: dict[int, bpy.types.Object]) -> None:
    """Remove the scanner's objects and rings; `replacements` are the new cameras by module number.

    The user's objects move out of the scanner, and whatever referred to an old camera refers to the new one.
    """
    parts, others = parts_and_others(collection)
    homes = [collection, *_rings(collection)]
    for own in _own_collections(collection):
        for home in homes:
            if own.name in home.children:
                home.children.unlink(own)
        if own not in set(scene.collection.children_recursive):
            scene.collection.children.link(own)
    for item in others:
        for home in homes:
            if item.name in home.objects:
                home.objects.unlink(item)
        if not item.users_collection:
            scene.collection.objects.link(item)

    ours = set(parts)
    new_of = {o: replacements.get(o.mphdrr_module.number) for o in parts if o.mphdrr_module.is_module}
    for item in bpy.data.objects:
        if item.parent in ours and item not in ours and new_of.get(item.parent) is None:
            cameras.unparent(item)

    datas = {o.data for o in parts if o.data is not None}
    bpy.data.batch_remove([o for o in parts if o not in new_of])
    rings = set(homes[1:])
    for camera, users in bpy.data.user_map(subset=set(new_of)).items():
        if new_of[camera] is not None and users - rings:
            camera.user_remap(new_of[camera])
    bpy.data.batch_remove([*new_of, *rings])
    bpy.data.batch_remove([data for data in datas if data.users == 0])


def parts_and_others(
    collection: bpy.types.Collection,
) -> tuple[list[bpy.types.Object], list[bpy.types.Object]]:
    """The scanner's own objects, and the user's: other objects, and copies of the scanner's."""
    parts, others = [], []
    seen: set[tuple[str, int]] = set()
    for item in sorted(collection.all_objects, key=lambda o: o.name):  # "Module 07" before its copy "Module 07.001"
        module = item.mphdrr_module
        key = (module.part, module.number)
        if module.part == "NONE" or key in seen:
            others.append(item)
        else:
            seen.add(key)
            parts.append(item)
    return parts, others


def _rings(collection: bpy.types.Collection) -> list[bpy.types.Collection]:
    return [c for c in collection.children if c.mphdrr_scanner.is_ring]


def _own_collections(collection: bpy.types.Collection) -> list[bpy.types.Collection]:
    """The user's collections directly inside the scanner or one of its rings."""
    return [c for home in (collection, *_rings(collection)) for c in home.children if not c.mphdrr_scanner.is_ring]


def modules_text(numbers: Sequence[int]) -> str:
    """ "module 7", or "modules 7, 12"."""
    return f"module{'s' * (len(numbers) > 1)} {_listed([str(n) for n in numbers])}"


def _listed(names: Sequence[str], most: int = 6) -> str:
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
