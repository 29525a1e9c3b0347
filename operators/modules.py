"""Operators on modules: show, aim, duplicate, remove, tidy, renumber, check and map them."""

import math

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..addon.blender import decimals, ids, jobs, reports
from ..addon.scanner import following, maps, module_edits, scanner, selection
from ..addon.scanner.scanner_parts import modules_text


class MPHDRR_OT_show_modules(selection.OnScanner, bpy.types.Operator):
    """Show or hide modules with their collimators and crystals, in the viewport and in renders."""

    modules: StringProperty(name="Modules", description="Numbers of modules, such as 1-40, 45; empty: all")
    mode: EnumProperty(
        name="Mode", description="What to do with these modules and the others", default="ONLY",
        items=[
            ("ONLY", "Show Only", "Show these modules and hide all others", 0),
            ("SHOW", "Show", "Show these modules; the others stay as they are", 1),
            ("HIDE", "Hide", "Hide these modules; the others stay as they are", 2),
            ("ALL", "Show All", "Show all modules", 3),
        ],
    )  # fmt: skip

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        return f"{ids.counted(scanner.show_modules(collection, self.modules, self.mode), 'module')} visible"


class MPHDRR_OT_isolate_ring(selection.OnModules, bpy.types.Operator):
    """Show only the modules of the active module's ring; if only they are shown, show all."""

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        cameras, ring = scanner.modules(collection), selection.selected_modules(context)[0].mphdrr_module.ring
        in_ring = {camera for camera in cameras if camera.mphdrr_module.ring == ring}
        is_isolated = in_ring == {camera for camera in cameras if camera.mphdrr_module.visible}
        for camera in cameras:
            scanner.set_visible(camera, is_isolated or camera in in_ring)
        return (
            "All modules visible" if is_isolated else f"Ring {ring + 1}: {ids.counted(len(in_ring), 'module')} visible"
        )


class MPHDRR_OT_look_through_module(selection.OnScanner, bpy.types.Operator):
    """Make the module's pinhole camera the scene's camera, and look through it."""

    number: IntProperty(name="Number", description="Module number", default=1)

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        context.scene.camera = scanner.module(collection, self.number)
        scanner.fit_pixels(context.scene.render, context.scene.camera)
        if context.area is not None and context.area.type == "VIEW_3D":
            context.area.spaces.active.region_3d.view_perspective = "CAMERA"
            if not bpy.app.background:
                bpy.ops.view3d.view_center_camera()  # fits the camera's whole image beside the headers
                context.area.spaces.active.region_3d.view_camera_zoom -= 6.0
        return f"Looking through {context.scene.camera.name}"


class MPHDRR_OT_aim_modules(selection.OnScanner, bpy.types.Operator):
    """Turn every module that does not look at the isocentre, without moving it."""

    bl_label = "Aim at Isocentre"

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        aimed = scanner.aim_modules(collection)
        return f"Turned {modules_text(aimed)}" if aimed else "All modules aim at the isocentre"


class MPHDRR_OT_duplicate_modules(selection.OnModules, bpy.types.Operator):
    """Copy the selected modules, with collimators and crystals, to further places on their rings."""

    bl_label = "Duplicate Along Ring"

    count: IntProperty(name="Copies", description="Number of copies of each module", default=1, min=1, soft_max=40)
    angle: FloatProperty(name="Angle", description="From one copy to the next, about the z axis", subtype="ANGLE",
                         default=math.radians(9.0), min=-math.pi, max=math.pi)  # fmt: skip
    follow_ring: BoolProperty(
        name="Follow Ring",
        description="Take z and the distance from the z axis from the ring's other modules at the new azimuth, so that "
        "copies stay on an elliptic arc. Otherwise the module is turned about z",
    )

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        modules = selection.selected_modules(context)
        copies = module_edits.duplicate_modules(collection, modules, self.count, self.angle, self.follow_ring)
        selection.select(context, copies)
        return f"Made {modules_text([camera.mphdrr_module.number for camera in copies])}"


class MPHDRR_OT_remove_modules(selection.OnModules, bpy.types.Operator):
    """Delete the selected modules with their collimators and crystals."""

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        modules = selection.selected_modules(context)
        text = modules_text([camera.mphdrr_module.number for camera in modules])
        module_edits.remove_modules(collection, modules)
        return f"Removed {text}"


class MPHDRR_OT_tidy_modules(selection.OnScanner, bpy.types.Operator):
    """Make modules of copied cameras, with numbers, collimators and crystals of their own, and remove collimators and
    crystals whose camera was deleted.
    """

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        results = [module_edits.tidy(scanner_collection) for scanner_collection in scanner.scanners(context.scene)]
        new, n_removed = [n for numbers, _ in results for n in numbers], sum(n for _, n in results)
        changes = [f"made {modules_text(new)}"] if new else []
        changes += [f"removed {n_removed} parts without a camera"] if n_removed else []
        return " and ".join(changes).capitalize() or "All modules are in order"


class MPHDRR_OT_renumber_modules(selection.OnScanner, bpy.types.Operator):
    """Number all modules 1, 2, ...; they are listed, projected and exported in that order from now on."""

    order: EnumProperty(
        name="Order", description="Order that the numbers follow",
        items=(
            ("RINGS", "By Ring and Azimuth", "Ring by ring along +z, and along each ring from its largest gap on", 0),
            ("LIST", "As Listed", "The present order: that of the workbook, then added modules", 1),
        ),
    )  # fmt: skip

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        changed = module_edits.renumber(collection, self.order)
        modules = ids.counted(len(scanner.modules(collection)), "module")
        return f"Numbered {modules}: {changed} have another number than before"


class MPHDRR_OT_reset_cameras(selection.OnScanner, bpy.types.Operator):
    """Set lens and sensor of the modules' cameras to what the projections show."""

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        reset = following.reset_views(collection)
        return f"Reset the cameras of {modules_text(reset)}" if reset else "All cameras see what their projections show"


class MPHDRR_OT_set_up_scene(selection.OnScanner, bpy.types.Operator):
    """Set the scene's units to millimetres, and look at the whole scanner: for a scanner from another file."""

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        scanner.set_up_scene(context.scene, collection)
        return f"The scene's units are millimetres; looking at '{collection.name}'"


class MPHDRR_OT_remove_scanner(selection.OnScanner, bpy.types.Operator):
    """Remove the scanner with its cameras, collimators, crystals and projections in the scene; your own objects stay."""

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        collection = scanner.required_scanner(context.scene)
        n = len(scanner.modules(collection))
        message = f"With its {n} modules; your own objects stay"
        return reports.ask_to_remove(self, context, event, f"Remove '{collection.name}'?", message)

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        name = collection.name
        module_edits.remove_scanner(context.scene, collection)
        return f"Removed '{name}'"


class MPHDRR_OT_check_geometry(selection.OnScanner, bpy.types.Operator):
    """Look for collimators and crystals that overlap, holes that another module blocks, and modules that do not see
    their ROI; select the modules concerned.
    """

    def change(self, context: bpy.types.Context, collection: bpy.types.Collection) -> str:
        findings, cameras = scanner.check_geometry(collection)
        if not findings:
            return "Nothing found"
        if cameras:
            selection.select(context, cameras)
        return f"{ids.counted(len(findings), 'finding')} at {ids.counted(len(cameras), 'module')}: see the Design panel"


class MPHDRR_OT_add_map(jobs.JobOperator, bpy.types.Operator):
    """Calculate a quantity of the scanner, with ideal modules, in every voxel around the isocentre, and show it as a volume,
    in place of the scanner's last map of this quantity.
    """

    poll = reports.needs(selection.SCANNER)

    quantity: EnumProperty(name="Quantity", description="Quantity to map", items=maps.QUANTITIES)
    voxels: IntProperty(
        name="Voxels", description="Voxels along each side of the map", default=64, min=2, soft_max=256, max=1024
    )
    side: FloatProperty(name="Side (mm)", description="Side of the map's cube in mm; 0 takes the diameter of the ROI",
                        default=0.0, min=0.0, soft_max=500.0)  # fmt: skip
    within_roi: BoolProperty(name="Within ROI", description="Set voxels outside the ROI sphere to 0", default=True)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return maps.map_job(context.scene, self.quantity, self.voxels, decimals.typed(self.side), self.within_roi)
