"""Prefixes, names of datablocks, and idnames and labels made from class names; needs no Blender."""

import re

PREFIX = "mphdrr"
CATEGORY = "mphDRR"  # the sidebar tab

# --- `bl_order` of panels, in the order of the work -------------------------------------------------------------------
ORDER_NEXT, ORDER_GEOMETRY, ORDER_PHANTOM, ORDER_PROJECTIONS, ORDER_RUNS, ORDER_RECONSTRUCTION = 0, 1, 10, 20, 25, 27
ORDER_EVENTS, ORDER_EXPORT = 28, 30

# --- Datablocks ---------------------------------------------------------------------------------------------
SCANNER = "Scanner"  # default name of a scanner's collection
PARTS = ("NONE", "CAMERA", "COLLIMATOR", "CRYSTAL", "ROI", "PLANE", "ARROWS")  # `Object.mphdrr_module.part`
MOSAIC = "mphDRR mosaic"
DIFFERENCE = "mphDRR difference"
RECONSTRUCTION = "mphDRR reconstruction"  # the image of the last reconstruction's slices and objective
RESIDUALS = "mphDRR residuals"  # the image of the last calibration's residuals
ARROWS = "Calibration"  # the object with the arrows from nominal to calibrated pinholes
PLANES = "mphDRR projections"  # the collection of the planes that show projections
PERSPECTIVES = "mphDRR perspective"  # the collection of volumes in modules' coordinates (`frustums.py`)
STUDIO = "mphDRR studio"  # the collection of the lights; also a world's name
_LOWERCASE_WORDS = ("from", "in")  # words without a capital in labels
PREVIEW = ".preview"  # part of the file names of coarser copies of large volumes, which are for display only


def operator_name(class_name: str) -> str:
    """Return the idname of an operator's class: "mphdrr.show_run" for "MPHDRR_OT_show_run"."""
    return class_name.replace("MPHDRR_OT_", f"{PREFIX}.")


def label(class_name: str) -> str:
    """Return the label of an operator or a panel: "Show Run" for "MPHDRR_OT_show_run"."""
    words = class_name.split("_")[2:]
    return " ".join(word if word in _LOWERCASE_WORDS else word.capitalize() for word in words)


def module_name(number: int, n_modules: int = 80, word: str = "Module") -> str:
    """Return the name of a module's camera object: "Module 07", padded so that names sort as numbers do."""
    return f"{word} {number:0{max(2, len(str(n_modules)))}d}"


def part_name(module: str, part: str) -> str:
    """Return the name of a part of the module called `module`: "Crystal 07"."""
    return re.sub(r"^[\w-]+(?= \d)", part.capitalize(), module)


def ring_name(ring: int) -> str:
    """Return the name of a ring's collection; `ring` counts from 0 as in `PinholeSystem.rings()`."""
    return f"Ring {ring + 1}"


def projection_name(number: int, n_modules: int = 80) -> str:
    """Return the name of a module's projection image: "mphDRR 07", padded as `module_name`."""
    return module_name(number, n_modules).replace("Module", "mphDRR")


def picture_name(projection: str) -> str:
    """Return the name of the coloured picture of a module's projection image: "mphDRR 07 picture"."""
    return f"{projection} picture"


def counted(number: int, word: str) -> str:
    """Return a number with a noun, such as "1 module" or "80 modules"."""
    return f"{number} {word}{'s' * (number != 1)}"
