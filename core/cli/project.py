"""``mphdrr project WORKBOOK --volume FILE -o run.h5``, ``mphdrr project run.toml -o run.h5``.

Every setting of `runs.settings` is an option; the help lists the most used ones.
"""

from __future__ import annotations

import argparse
import itertools
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
from .recipe_options import add_entries, add_option, add_setting, typed_entries

_LISTED = (
    *("system.columns", "system.modules", "volume.file", "volume.states", "volume.center", "phantom.file"),
    *("counts.files", "counts.frames", "counts.frames_file", "counts.orientation", "counts.expected"),
    *("attenuation.file", "model.time", "model.isotope", "model.hole", "detector.plane", "detector.magnification"),
    *("noise.seed", "compute.backend", "compute.threads"),
)
"""Settings whose options the help lists; the others it leaves to --set and the recipe."""

_BY_HAND = ("model.kind", "model.photons", "detector.rows", "detector.columns", "volume.energy")

# Options of the Derenzo phantom by the settings that they stand for.
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
    """Add the command."""
    parser = add_run(subparsers, "project", _run)
    text = "geometry workbook (.xlsx, .xlsm), recipe (.toml), or run (.h5, .npz, .pt), to be made again"
    parser.add_argument("file", nargs="?", metavar="FILE", help=text)
    for setting in SETTINGS.values():
        if setting.key not in _BY_HAND and not setting.key.startswith("reconstruction."):
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


def _changes(arguments: argparse.Namespace, recipe: mph.Recipe) -> dict[str, Any]:
    """What the options change, by the keys of recipes."""
    typed, changes = vars(arguments), typed_entries(arguments)
    if changes.get("model.photons") is not None:
        changes.setdefault("model.kind", "transmission")
    if changes.get("counts.files") is not None:
        changes.setdefault("model.kind", "emission")
    if "energy" in typed:
        # Counts are of activity: the CT numbers are those of the attenuation.
        is_counts = changes.get("model.kind", recipe["model.kind"]) == "emission"
        changes["attenuation.energy" if is_counts else "volume.energy"] = typed["energy"]
    if changes.get("phantom.file") in [kind.name for kind in KINDS]:
        changes["phantom.kind"] = changes.pop("phantom.file")
    if any(key.startswith("phantom.") for key in changes):  # then it is not the object of the scene any more
        changes.setdefault("volume.object", None)
    return changes


def _chosen(arguments: argparse.Namespace) -> tuple[mph.Recipe, dict[str, Any]]:
    """The recipe of the options, and from a run that it began with the scanner and the volume if it still has them."""
    file, recipe, run = arguments.file, mph.Recipe(), None
    suffix = Path(file or "").suffix.lower()
    if suffix == ".toml":
        recipe = mph.read_recipe(file)
    elif suffix in FORMATS:
        run = mph.read_run(file)
        recipe = run.recipe
    elif file is not None:
        recipe = mph.Recipe({"system.file": file})
    before = recipe.tables()
    preset = {} if arguments.preset is None else PRESETS[arguments.preset].changes
    recipe = recipe.updated(preset)
    isotope = {key: preset[key] for key in preset if key == "model.isotope"}  # which images of photons alone have
    recipe = recipe.updated({**isotope, **_changes(arguments, recipe)})
    if run is None:
        return recipe, {}
    now = recipe.tables()
    kept: dict[str, Any] = {}
    if now.get("system") == before.get("system"):
        kept["system"] = run.system
    # An attenuation that is made with the volume, or moved with it, needs the volume made anew.
    together = recipe["attenuation.of_phantom"] or (recipe["volume.center"] and "attenuation" in now)
    if not together and all(now.get(table) == before.get(table) for table in ("volume", "phantom")):
        if run.volume is None and recipe["counts.files"] is None:
            found = "it holds measured counts, not what was measured"
            raise mph.InputError(f"{file}: {found}; name a volume, a phantom, or --counts")
        kept["volume"] = run.volume
        if run.recipe["model.kind"] == recipe["model.kind"] == "spectral":  # whose runs hold mu at that energy
            recipe = recipe.updated({"volume.energy": CT_ENERGY})
    return recipe, kept


def _run(arguments: argparse.Namespace) -> None:
    """Project a volume, or a phantom, into every module; or take measured counts for the projections.

    mphdrr project scanner.xlsx --volume ct.nii.gz --energy 60 --size 250 250 -o run.h5
    mphdrr project scanner.xlsx --volume heart.nii.gz --mu ct-mu.nii.gz --preset tc99m-tungsten-czt --time 600
        --write-recipe heart.toml
    mphdrr project heart.toml --noise 1 -o counts.h5
    mphdrr project scanner.xlsx --counts counts.npy --frames 1-80 --orientation front+v --time 600 -o run.h5
        --mosaic check.png
    """
    from ..runs.run_recipe import recipe_frames

    if arguments.write_recipe:
        path = output_path(arguments.write_recipe, (".toml",))
        recipe, _ = _chosen(arguments)
        mph.write_recipe(recipe, path)
        print(path)
        return
    if not arguments.output:
        raise mph.InputError("nothing to write: give --output FILE, or --write-recipe FILE")
    path = output_path(arguments.output, FORMATS)
    picture = output_path(arguments.mosaic) if arguments.mosaic else None
    recipe, kept = _chosen(arguments)
    count = len(recipe_frames(recipe))
    outputs = {numbered_path(path, number, count).resolve() for number in range(1, count + 1)}
    several = (recipe[key] or () for key in ("volume.states", "counts.files", "attenuation.file"))
    for file in (*itertools.chain(*several), recipe["volume.file"]):
        if file is not None and Path(file).resolve() in outputs:
            wrong = "the projections would replace what they are made from"
            raise mph.InputError(f"{file}: {wrong}; choose another --output")
    for number, run in enumerate(mph.run_recipe(recipe, **kept, stages=progress_bar), 1):
        file = numbered_path(path, number, count)
        mph.write_run(run, file)
        if picture is not None:
            write_sheet(run, numbered_path(picture, number, count))
        views, (n_v, n_u) = len(run.views), run.views.shape
        plural, largest = "s" * (views > 1), float(run.projections.max())
        print(f"{file}: {views} projection{plural} of {n_v} x {n_u} pixels, largest {largest:.4g} {run.unit}")
