"""Commands ``mphdrr project WORKBOOK --volume FILE -o run.h5`` and ``mphdrr project run.toml -o run.h5``.

Every setting of `runs.settings` is an option; the help lists the most used ones.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ... import core as mph
from ..phantoms.kinds import KINDS
from ..physics.ct_numbers import CT_ENERGY
from ..runs import FORMATS
from ..runs.mosaic import write_sheet
from ..runs.presets import PRESETS
from ..runs.settings import SETTINGS
from .options import add_run, numbered_path, output_path, progress_bar
from .recipe_options import add_entries, add_option, add_setting, entries_from_options

_LISTED = (
    *("system.columns", "system.modules", "volume.file", "volume.states", "volume.center", "phantom.file"),
    *("counts.files", "counts.frames", "counts.frames_file", "counts.orientation", "counts.expected"),
    *("attenuation.file", "model.time", "model.isotope", "model.hole", "detector.plane", "detector.magnification"),
    *("noise.seed", "compute.backend", "compute.threads"),
)
"""Settings whose options are in the help; it leaves the others to --set and the recipe."""

_OWN_OPTIONS = ("model.kind", "model.photons", "detector.rows", "detector.columns", "volume.energy")
"""Settings whose options are not made from the table of settings."""

# Option of the Derenzo phantom -> the settings that it stands for.
_DERENZO = {
    "--radius": ("phantom.radius",),
    "--rods": ("phantom.rod_diameters",),
    "--sectors": ("phantom.sectors",),
    "--height": ("phantom.height",),
    "--activity": ("phantom.activity",),
    "--water": ("phantom.cylinder_radius", "phantom.cylinder_height"),
    "--background": ("phantom.background",),
}


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command ``mphdrr project``."""
    parser = add_run(subparsers, "project", _run)
    text = "geometry workbook (.xlsx, .xlsm), recipe (.toml), or run (.h5, .npz, .pt) to be made again"
    parser.add_argument("file", nargs="?", metavar="FILE", help=text)
    for setting in SETTINGS.values():
        if setting.key not in _OWN_OPTIONS and not setting.key.startswith("reconstruction."):
            add_setting(parser, setting, setting.key in _LISTED)
    size = ("detector.rows", "detector.columns")
    add_option(parser, "--size", size, "Pixels, rows and columns (default: 256 256)", nargs=2)
    add_option(parser, "--energy", ("energy",), SETTINGS["volume.energy"].help, metavar="KEV")
    model = parser.add_mutually_exclusive_group()
    for word, (_, text) in SETTINGS["model.kind"].words.items():
        add_option(model, f"--{word}", ("model.kind",), text, action="store_const", const=word)
    add_option(model, "--photons", ("model.photons",), SETTINGS["model.photons"].help)
    text = f"physics of counts in one choice, which options override: {', '.join(PRESETS)}"
    parser.add_argument("--preset", choices=PRESETS, metavar="NAME", help=text)
    for option, keys in _DERENZO.items():
        nargs = "+" if option == "--rods" else len(keys) if len(keys) > 1 else None
        add_option(parser, option, keys, argparse.SUPPRESS, nargs=nargs)
    add_entries(parser)
    text = "write the recipe (.toml) of these options, all settings explained in it, instead of projecting"
    parser.add_argument("--write-recipe", metavar="FILE", help=text)
    parser.add_argument("-o", "--output", metavar="FILE", help=", ".join(FORMATS))
    parser.add_argument("--mosaic", metavar="PNG", help="also write all images in one picture")


def _changes_from_options(arguments: argparse.Namespace, recipe: mph.Recipe) -> dict[str, Any]:
    """Return the recipe entries that the options change, by key; None marks an entry to delete."""
    typed, changes = vars(arguments), entries_from_options(arguments)
    if changes.get("model.photons") is not None:
        changes.setdefault("model.kind", "transmission")
    if changes.get("counts.files") is not None:
        changes.setdefault("model.kind", "emission")
    if "energy" in typed:
        # Counts come from an activity, so the CT numbers are those of the attenuation.
        is_counts = changes.get("model.kind", recipe["model.kind"]) == "emission"
        changes["attenuation.energy" if is_counts else "volume.energy"] = typed["energy"]
    if changes.get("phantom.file") in [kind.name for kind in KINDS]:
        changes["phantom.kind"] = changes.pop("phantom.file")
    if any(key.startswith("phantom.") for key in changes):  # the phantom replaces an object of the scene
        changes.setdefault("volume.object", None)
    return changes


def _recipe_and_data(arguments: argparse.Namespace) -> tuple[mph.Recipe, dict[str, Any]]:
    """Return the recipe of the options, and the scanner and the volume of a given run as far as the recipe keeps them.

    The latter are keyword arguments of `run_recipe`: "system" and "volume".
    """
    file, recipe, run = arguments.file, mph.Recipe(), None
    suffix = Path(file or "").suffix.lower()
    if suffix == ".toml":
        recipe = mph.read_recipe(file)
    elif suffix in FORMATS:
        run = mph.read_run(file)
        recipe = run.recipe
    elif file is not None:
        recipe = mph.Recipe({"system.file": file})
    old_tables = recipe.tables()
    preset = {} if arguments.preset is None else PRESETS[arguments.preset].changes
    recipe = recipe.updated(preset)
    preset_isotope = {key: preset[key] for key in preset if key == "model.isotope"}  # only a model of photons has it
    recipe = recipe.updated({**preset_isotope, **_changes_from_options(arguments, recipe)})
    if run is None:
        return recipe, {}
    new_tables = recipe.tables()
    data: dict[str, Any] = {}
    if new_tables.get("system") == old_tables.get("system"):
        data["system"] = run.system
    # An attenuation that is made or moved together with the volume needs a new volume.
    is_made_together = recipe["attenuation.of_phantom"] or (recipe["volume.center"] and "attenuation" in new_tables)
    if not is_made_together and all(new_tables.get(table) == old_tables.get(table) for table in ("volume", "phantom")):
        if run.volume is None and recipe["counts.files"] is None:
            problem = "it holds measured counts, not what was measured"
            raise mph.InputError(f"{file}: {problem}; name a volume, a phantom, or --counts")
        data["volume"] = run.volume
        if run.recipe["model.kind"] == recipe["model.kind"] == "spectral":  # a spectral run holds mu at this energy
            recipe = recipe.updated({"volume.energy": CT_ENERGY})
    return recipe, data


def _run(arguments: argparse.Namespace) -> None:
    """Project a volume, or a phantom, into every module; or use measured counts as the projections.

    mphdrr project scanner.xlsx --volume ct.nii.gz --energy 60 --size 250 250 -o run.h5
    mphdrr project scanner.xlsx --volume heart.nii.gz --mu ct-mu.nii.gz --preset tc99m-tungsten-czt --time 600
        --write-recipe heart.toml
    mphdrr project heart.toml --noise 1 -o counts.h5
    mphdrr project scanner.xlsx --counts counts.npy --frames 1-80 --orientation front+v --time 600 -o run.h5
        --mosaic check.png
    """
    from ..runs.recipe import note_files
    from ..runs.run_recipe import recipe_frames

    if arguments.write_recipe:
        path = output_path(arguments.write_recipe, (".toml",))
        recipe, _ = _recipe_and_data(arguments)
        mph.write_recipe(recipe, path)
        print(path)
        return
    if not arguments.output:
        raise mph.InputError("nothing to write: give --output FILE, or --write-recipe FILE")
    path = output_path(arguments.output, FORMATS)
    picture = output_path(arguments.mosaic) if arguments.mosaic else None
    recipe, data = _recipe_and_data(arguments)
    n_runs = len(recipe_frames(recipe))
    for output in filter(None, (path, picture) if n_runs > 1 else ()):
        for number in range(1, n_runs + 1):
            output_path(str(numbered_path(output, number, n_runs)))
    note_files(recipe)
    for number, run in enumerate(mph.run_recipe(recipe, **data, stages=progress_bar), 1):
        file = numbered_path(path, number, n_runs)
        mph.write_run(run, file)
        if picture is not None:
            write_sheet(run, numbered_path(picture, number, n_runs))
        views, (n_v, n_u) = len(run.views), run.views.shape
        plural, largest = "s" * (views > 1), float(run.projections.max())
        print(f"{file}: {views} projection{plural} of {n_v} x {n_u} pixels, largest {largest:.4g} {run.unit}")
