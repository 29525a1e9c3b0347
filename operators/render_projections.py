"""Project a volume into the scanner's modules, as a job."""

from __future__ import annotations

import time
from collections.abc import Generator
from typing import TYPE_CHECKING, Any

import bpy
from bpy.props import StringProperty

from ..addon import ids, images, jobs, runs, scanner, storage, volumes
from ..addon.projection_properties import ProjectionSettings
from ..core.errors import InputError
from ..core.memory import require
from ..core.progress import Progress
from ..core.run import ProjectionRun
from ..core.system import PinholeSystem

if TYPE_CHECKING:
    from ..core.projector import Model


class MPHDRR_OT_render_projections(ProjectionSettings, jobs.JobOperator, bpy.types.Operator):
    bl_idname = ids.RENDER_PROJECTIONS
    bl_label = "Render Projections"
    bl_description = (
        "Project the volume into every module: exact line integrals or SPECT counts, stored as images and as a file "
        "beside the .blend. Settings that a script leaves out are those of the panel"
    )
    bl_options = {"REGISTER", "UNDO"}

    volume: StringProperty(name="Volume", description="Name of the volume object to project", options={"SKIP_SAVE"})

    def job(self, context: bpy.types.Context) -> jobs.Job:
        scene = context.scene
        collection = scanner.active_scanner(scene)
        if collection is None:
            raise InputError("no scanner in the scene: import a workbook first")
        system = _range(scanner.read_scanner(collection), self._setting(scene, "first"), self._setting(scene, "last"))
        shape = (self._setting(scene, "height"), self._setting(scene, "width"))
        detector = self._setting(scene, "detector").lower()
        magnification = float(f"{self._setting(scene, 'magnification'):.7g}")
        backend = self._setting(scene, "backend").lower()
        model = _model(system, self._setting(scene, "model"), float(f"{self._setting(scene, 'time'):.7g}"))
        item = _chosen_volume(context, self.volume)
        read_volume = volumes.reader(item)
        n_bytes = 4.0 * len(system) * shape[0] * shape[1]
        # The array, and Blender's images with four channels in memory and once more, packed.
        require(9 * n_bytes, f"{len(system)} images of {shape[1]} x {shape[0]} pixels")
        path = storage.folder() / f"{bpy.path.clean_name(scene.name)}-projections.h5"
        settings: dict[str, Any] = {"volume": item.name}
        if getattr(item, ids.OBJECT_VOLUME).kind == "DERENZO":
            settings |= getattr(item, ids.OBJECT_VOLUME).derenzo.recipe()
        scene_name, item_name, start = scene.name, item.name, time.perf_counter()

        def work(progress: Progress) -> ProjectionRun:
            from ..core.export import write_run
            from ..core.project import project_run

            progress(0, len(system))
            run = project_run(
                system,
                read_volume(),
                model=model,
                shape=shape,
                detector=detector,
                magnification=magnification,
                backend=backend,
                settings=settings,
                progress=progress,
            )
            write_run(run, path)
            return run

        def finish(run: ProjectionRun) -> Generator[None, None, str]:
            mosaic = yield from images.storing(run.projections, run.system.numbers)
            images.show(mosaic, bpy.context)
            scene = bpy.data.scenes.get(scene_name)
            if scene is None:
                raise InputError(f"the scene {scene_name!r} is gone; its projections are in {path}")
            runs.record_run(scene, run, path)
            seconds = time.perf_counter() - start
            where = path if bpy.data.filepath else f"{path} until the .blend is saved"
            return f"Projected {item_name!r} into {len(run.views)} modules in {seconds:.1f} s: {where}"

        return jobs.Job("Projecting", work, finish)

    def _setting(self, scene: bpy.types.Scene, name: str) -> Any:
        """A setting as given to the operator, else the panel's."""
        return getattr(self if self.properties.is_property_set(name) else getattr(scene, ids.SCENE_PROJECTIONS), name)


class MPHDRR_OT_show_projections(bpy.types.Operator):
    bl_idname = ids.SHOW_PROJECTIONS
    bl_label = "Show Projections"
    bl_description = "Show the mosaic of the last run in an Image Editor, opened below the 3D view if there is none"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return ids.MOSAIC in bpy.data.images

    def execute(self, context: bpy.types.Context) -> set[str]:
        if not images.show_below(bpy.data.images[ids.MOSAIC], context):
            self.report({"ERROR"}, "no window with a 3D view to open an Image Editor in")
            return {"CANCELLED"}
        return {"FINISHED"}


def _model(system: PinholeSystem, kind: str, time: float) -> Model:
    from ..core.projector import Emission, Transmission

    return Emission(system, time=time) if kind == "EMISSION" else Transmission()


def _range(system: PinholeSystem, first: int, last: int) -> PinholeSystem:
    """The modules numbered `first` to `last`; 0 leaves an end open."""
    numbers = system.numbers
    chosen = (numbers >= first) & (numbers <= (last or numbers.max()))
    if not chosen.any():
        raise InputError(
            f"no module is numbered {first} to {last or numbers.max()}: this scanner has {numbers.min()} to {numbers.max()}"
        )
    return system[chosen]


def _chosen_volume(context: bpy.types.Context, name: str) -> bpy.types.Object:
    """The volume named, else the panel's, else the active one, else the only one."""
    known = volumes.volume_objects(context.scene)
    if name:
        for item in known:
            if item.name == name:
                return item
        raise InputError(f"no volume is named {name!r}; there are: {', '.join(item.name for item in known) or 'none'}")
    chosen = getattr(context.scene, ids.SCENE_PROJECTIONS).volume
    for item in (chosen, context.object):
        if item in known:
            return item
    if len(known) != 1:
        raise InputError(
            f"choose what to project: there are {len(known)} volumes"
            if known
            else "no volume in the scene: add a phantom first"
        )
    return known[0]
