"""Prefixes, names of datablocks, and what follows from the names of classes: idnames and labels. Needs no Blender."""

import re

PREFIX = "mphdrr"
CATEGORY = "mphDRR"  # the sidebar tab

# --- Panels, drawn in the order of the work: bl_order -----------------------------------------------------------------
ORDER_NEXT, ORDER_GEOMETRY, ORDER_PHANTOM, ORDER_PROJECTIONS, ORDER_RUNS, ORDER_RECONSTRUCTION = 0, 1, 10, 20, 25, 27
ORDER_EVENTS, ORDER_EXPORT = 28, 30

# --- Datablocks ---------------------------------------------------------------------------------------------
SCANNER = "Scanner"  # default name of a scanner's collection
PARTS = ("NONE", "CAMERA", "COLLIMATOR", "CRYSTAL", "ROI", "PLANE", "ARROWS")  # `Object.mphdrr_module.part`
MOSAIC = "mphDRR mosaic"
DIFFERENCE = "mphDRR difference"
RECONSTRUCTION = "mphDRR reconstruction"  # slices of the last one, and its objective
RESIDUALS = "mphDRR residuals"  # of the last calibration
ARROWS = "Calibration"  # the object of the arrows from nominal to found pinholes
PLANES = "mphDRR projections"  # the collection of the planes that show them
PERSPECTIVES = "mphDRR perspective"  # the collection of volumes in modules' coordinates (`frustums.py`)
STUDIO = "mphDRR studio"  # the collection of the lights, and a world
_SMALL = ("from", "in")  # words without a capital in labels
PREVIEW = ".preview"  # in the names of coarser copies of large volumes, for display only


def operator_name(class_name: str) -> str:
    """The idname of an operator's class: "mphdrr.show_run" of "MPHDRR_OT_show_run"."""
    return class_name.replace("MPHDRR_OT_", f"{PREFIX}.")


def label(class_name: str) -> str:
    """What the user reads of an operator or a panel: "Show Run" of "MPHDRR_OT_show_run"."""
    words = class_name.split("_")[2:]
    return " ".join(word if word in _SMALL else word.capitalize() for word in words)


def module_name(number: int, n_modules: int = 80, word: str = "Module") -> str:
    """Name of a module's camera object: "Module 07", padded so that names sort as numbers do."""
    return f"{word} {number:0{max(2, len(str(n_modules)))}d}"


def part_name(module: str, part: str) -> str:
    """Name of a part of the module called `module`: "Crystal 07"."""
    return re.sub(r"^[\w-]+(?= \d)", part.capitalize(), module)


def ring_name(ring: int) -> str:
    """Name of a ring's collection; `ring` counts from 0 as in `PinholeSystem.rings()`."""
    return f"Ring {ring + 1}"


def projection_name(number: int, n_modules: int = 80) -> str:
    """Name of a module's projection image: "mphDRR 07", padded as `module_name`."""
    return module_name(number, n_modules).replace("Module", "mphDRR")


def picture_name(projection: str) -> str:
    """Name of the picture of a module's projection, in colours: "mphDRR 07 picture"."""
    return f"{projection} picture"
