"""Every idname, datablock name and prefix of the extension. Needs no Blender."""

PREFIX = "mphdrr"
CATEGORY = "mphDRR"  # the sidebar tab

# --- Operators: idname as in `bpy.ops.<idname>`, see `operator_name` --------------------------------------------------
IMPORT_GEOMETRY = "mphdrr.import_geometry"
BROWSE_EXAMPLE = "mphdrr.browse_example"
LOAD_EXAMPLE = "mphdrr.load_example"
SHOW_MODULES = "mphdrr.show_modules"
LOOK_THROUGH_MODULE = "mphdrr.look_through_module"
AIM_MODULES = "mphdrr.aim_modules"
EXPORT_GEOMETRY = "mphdrr.export_geometry"
DUPLICATE_MODULES = "mphdrr.duplicate_modules"
REMOVE_MODULES = "mphdrr.remove_modules"
TIDY_MODULES = "mphdrr.tidy_modules"
RENUMBER_MODULES = "mphdrr.renumber_modules"
RESET_CAMERAS = "mphdrr.reset_cameras"
SET_UP_SCENE = "mphdrr.set_up_scene"
REMOVE_SCANNER = "mphdrr.remove_scanner"
CHECK_GEOMETRY = "mphdrr.check_geometry"
ADD_MAP = "mphdrr.add_map"
EXPORT_FOR_PROGRAM = "mphdrr.export_for_program"
VOXELIZE_OBJECTS = "mphdrr.voxelize_objects"
MESH_FROM_VOLUME = "mphdrr.mesh_from_volume"
ADD_PHANTOM = "mphdrr.add_"  # and the kind: mphdrr.add_derenzo, mphdrr.add_nema, ...
IMPORT_PHANTOM = "mphdrr.import_phantom"
UPDATE_PHANTOM = "mphdrr.update_phantom"
APPLY_PHANTOM_POSE = "mphdrr.apply_phantom_pose"
SHOW_PHANTOM_OUTLINE = "mphdrr.show_phantom_outline"
IMPORT_VOLUME = "mphdrr.import_volume"
IMPORT_VOLUME_SEQUENCE = "mphdrr.import_volume_sequence"
IMPORT_COUNTS = "mphdrr.import_counts"
CT_TO_ATTENUATION = "mphdrr.ct_to_attenuation"
ADD_SLICES = "mphdrr.add_slices"
REMOVE_SLICES = "mphdrr.remove_slices"
CLEAN_VOLUME_FILES = "mphdrr.clean_volume_files"
REMAKE_VOLUMES = "mphdrr.remake_volumes"
FIND_VOLUME_FILES = "mphdrr.find_volume_files"
EXPORT_VOLUME = "mphdrr.export_volume"
RENDER_PROJECTIONS = "mphdrr.render_projections"
EXPORT_DATASET = "mphdrr.export_dataset"
USE_PRESET = "mphdrr.use_preset"
LOAD_RECIPE = "mphdrr.load_recipe"
SHOW_PROJECTIONS = "mphdrr.show_projections"
EXPORT_FIGURE = "mphdrr.export_figure"
REMOVE_RUN = "mphdrr.remove_run"
COMPARE_RUNS = "mphdrr.compare_runs"
LIVE_PREVIEW = "mphdrr.live_preview"
PICK_MODULE = "mphdrr.pick_module"
PICK_WINDOW = "mphdrr.pick_window"
PICK_PIXEL = "mphdrr.pick_pixel"
CLEAR_PIXEL = "mphdrr.clear_pixel"
CLEAN_CACHE = "mphdrr.clean_cache"
CANCEL_JOB = "mphdrr.cancel_job"
FINISH_JOB = "mphdrr.finish_job"
RECONSTRUCT = "mphdrr.reconstruct"
SHOW_RECONSTRUCTION = "mphdrr.show_reconstruction"
BACKPROJECT = "mphdrr.backproject"
SHOW_IN_PERSPECTIVE = "mphdrr.show_in_perspective"
CLEAR_PERSPECTIVE = "mphdrr.clear_perspective"
RESAMPLE_IN_PERSPECTIVE = "mphdrr.resample_in_perspective"
NEW_EVENT_RECIPE = "mphdrr.new_event_recipe"
TRY_EVENT = "mphdrr.try_event"
MAKE_EVENT_SET = "mphdrr.make_event_set"
OPEN_EVENT = "mphdrr.open_event"

# --- Panels, drawn in the order of the work: bl_order -----------------------------------------------------------------
ORDER_GEOMETRY, ORDER_PHANTOM, ORDER_PROJECTIONS, ORDER_RUNS, ORDER_RECONSTRUCTION = 0, 10, 20, 25, 27
ORDER_EVENTS, ORDER_EXPORT = 28, 30

# --- Datablocks ---------------------------------------------------------------------------------------------
SCANNER = "Scanner"  # default name of a scanner's collection
PARTS = ("NONE", "CAMERA", "COLLIMATOR", "CRYSTAL", "ROI", "PLANE")  # `Object.mphdrr_module.part`
MOSAIC = "mphDRR mosaic"
DIFFERENCE = "mphDRR difference"
RECONSTRUCTION = "mphDRR reconstruction"  # slices of the last one, and its objective
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


def module_name(number: int, n_modules: int = 80) -> str:
    """Name of a module's camera object: "Module 07", padded so that names sort as numbers do."""
    return f"Module {number:0{max(2, len(str(n_modules)))}d}"


def part_name(module: str, part: str) -> str:
    """Name of a part of the module called `module`: "Crystal 07"."""
    return module.replace("Module", part.capitalize())


def ring_name(ring: int) -> str:
    """Name of a ring's collection; `ring` counts from 0 as in `PinholeSystem.rings()`."""
    return f"Ring {ring + 1}"


def projection_name(number: int, n_modules: int = 80) -> str:
    """Name of a module's projection image: "mphDRR 07", padded as `module_name`."""
    return module_name(number, n_modules).replace("Module", "mphDRR")


def picture_name(projection: str) -> str:
    """Name of the picture of a module's projection, in colours: "mphDRR 07 picture"."""
    return f"{projection} picture"
