"""Preferences > Add-ons > mphDRR: backends and why others are missing, threads, the cache, the example, the website."""

from __future__ import annotations

import functools
import shutil
import tomllib
from pathlib import Path

import bpy
import rna_keymap_ui
from bpy.app.translations import pgettext_iface as iface
from bpy.props import BoolProperty, IntProperty

from ..core import cache
from ..core.memory import readable_size
from ..core.rays import backends, parallel
from .blender import storage
from .blender.layouts import invoking

PIE, PIE_KEYMAP = "MPHDRR_MT_module", "Object Mode"  # the menu on a key, and Blender's keymap with that key
PACKAGE = __package__.rpartition(".")[0]  # "mphdrr", or "bl_ext.<repo>.mphdrr" for an installed extension


def _apply(self: MPHDRR_Preferences, context: bpy.types.Context) -> None:
    """Apply edited preferences."""
    parallel.set_usual_threads(self.threads or None)
    storage.copies = self.copies


class MPHDRR_Preferences(bpy.types.AddonPreferences):
    """Settings for all scenes."""

    bl_idname = PACKAGE

    threads: IntProperty(name="Threads",
                         description="Processor threads for projections unless the panel sets them; 0: all", default=0,
                         min=0, soft_max=64, update=_apply)  # fmt: skip
    copies: BoolProperty(
        name="Save As Copies Files", description="Copy the voxels and runs of a scene into the folder beside the new "
        ".blend; else both .blend files share those of the old one",
        default=True, update=_apply,
    )  # fmt: skip

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the preferences; called by Blender."""
        layout = self.layout
        row = invoking(layout.row())
        row.operator("mphdrr.load_example", icon="PLAY")
        row.operator("mphdrr.add_looks", icon="ASSET_MANAGER")
        if website():
            row.operator("wm.url_open", text="Website and Documentation", icon="URL").url = website()
        box = layout.box()
        box.label(text="What computes the projections:")
        names, states = (split := box.split(factor=0.2)).column(align=True), split.column(align=True)
        for name, state in backends.states().items():
            names.label(text=backends.BACKENDS[name].label)
            states.label(text=state[:1].upper() + state[1:])
        layout.use_property_split = True
        layout.prop(self, "threads", text="Threads" if self.threads else "Threads (0: all)")
        layout.prop(self, "copies")
        keyconfig = context.window_manager.keyconfigs.user
        keymap = keyconfig.keymaps.get(PIE_KEYMAP)
        for item in keymap.keymap_items if keymap else ():
            if getattr(item.properties, "name", "") == PIE:
                rna_keymap_ui.draw_kmi([], keyconfig, keymap, item, layout, 0)
        if (folder := own_folder()) is not None:
            row = layout.row()
            text = iface("Compiled code, {size} in {folder}")
            row.label(text=text.format(size=readable_size(cache_size()), folder=folder), translate=False)
            row.operator("mphdrr.clean_cache", text="Clean", icon="TRASH")


def own_folder(name: str = "cache") -> Path | None:
    """Return a folder in the extension's own one for files that can be made again; None without an installed extension."""
    try:
        return Path(bpy.utils.extension_path_user(PACKAGE, path=name))
    except ValueError:
        return None


def cache_size() -> int:
    """Return the bytes of the files in `own_folder`."""
    folder = own_folder()
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if folder else 0


def clean_cache() -> str:
    """Delete the files in `own_folder`, and return the line to report."""
    size, folder = cache_size(), own_folder()
    if folder is not None:
        shutil.rmtree(folder, ignore_errors=True)  # a library that is loaded cannot be deleted on Windows
    return f"Deleted {readable_size(size - cache_size())}"


@functools.cache
def website() -> str:
    """Return the extension's website from its manifest; "" for none."""
    manifest = Path(__file__).parents[1] / "blender_manifest.toml"
    return tomllib.loads(manifest.read_text(encoding="utf-8")).get("website", "") if manifest.is_file() else ""


def apply() -> None:
    """Apply the preferences when the extension is enabled."""
    folder, addon = own_folder(), bpy.context.preferences.addons.get(PACKAGE)
    cache.keep_in(folder)
    if addon is not None and addon.preferences is not None:
        _apply(addon.preferences, bpy.context)
