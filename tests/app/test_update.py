"""The extension from a repository of one's own, without network: installed in version 0.1.0, updated to this one, used."""

from __future__ import annotations

import os
import shutil
import zipfile
from pathlib import Path

OLD = os.environ.get("MPHDRR_OLD_ZIP")
"""A zip of version 0.1.0; without it this one's contents under that number stand for it."""
MODULE = "bl_ext.own.mphdrr"
BEFORE = f"""
import bpy, pathlib, sys
root = pathlib.Path(sys.modules["{MODULE}"].__file__).parent
bpy.ops.wm.read_homefile(use_empty=True)
bpy.ops.mphdrr.import_geometry(filepath=str(root / "examples" / "dc-spect-80.xlsx"))
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[-1])
print("BEFORE", len([x for x in bpy.data.objects if x.type == "CAMERA"]))
"""
AFTER = f"""
import addon_utils, bpy, importlib, sys
bpy.ops.wm.open_mainfile(filepath=sys.argv[-1])
scanner = importlib.import_module("{MODULE}.addon.scanner.scanner")
modules = len(scanner.read_scanner(scanner.active_scanner(bpy.context.scene)))
bpy.ops.wm.read_homefile(use_empty=True)
bpy.ops.mphdrr.load_example()
version = importlib.import_module("{MODULE}.core.version").VERSION
print("AFTER", version, modules, len(bpy.context.scene.mphdrr_projections.runs))
"""


def renumbered(path: Path, made: Path, version: str) -> None:
    """Copy a zip under another version's number."""
    with zipfile.ZipFile(path) as given, zipfile.ZipFile(made, "w") as new:
        for entry in given.infolist():
            data = given.read(entry)
            if entry.filename == "blender_manifest.toml":
                current = path.name.split("-")[1]
                data = data.replace(f'version = "{current}"'.encode(), f'version = "{version}"'.encode(), 1)
            new.writestr(entry, data)


def test_it_updates_from_a_repository(extension_zip: Path, new_blender, work_folder: Path):
    repository, scene, script = work_folder / "repository", work_folder / "scene.blend", work_folder / "script.py"
    repository.mkdir()

    def extension(*words: object) -> None:  # Blender synchronizes in online mode alone, be it with a folder
        new_blender("--online-mode", "--command", "extension", *map(str, words))

    def said(text: str) -> list[str]:
        script.write_text(text, encoding="utf-8")
        done = new_blender("--background", "--python-exit-code", "3", "--python", script, "--", scene)
        assert "Traceback" not in done.stderr, done.stderr
        return next(line for line in done.stdout.splitlines() if line.startswith(("BEFORE", "AFTER"))).split()

    old = repository / "mphdrr-0.1.0-linux_x64.zip"
    shutil.copy(OLD, old) if OLD else renumbered(extension_zip, old, "0.1.0")
    extension("server-generate", "--repo-dir", repository)
    extension("repo-add", "own", "--url", f"file://{repository}/index.json", "--clear-all")
    extension("install", "--sync", "--enable", "mphdrr")
    assert said(BEFORE) == ["BEFORE", "80"]

    shutil.copy(extension_zip, repository)
    old.unlink()
    extension("server-generate", "--repo-dir", repository)
    extension("update", "--sync")
    assert said(AFTER) == ["AFTER", extension_zip.name.split("-")[1], "80", "1"]
