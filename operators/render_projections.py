"""Project a volume into the scanner's modules, as a job."""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Sequence
from typing import Any

import bpy
from bpy.props import FloatProperty, StringProperty

from ..addon import ids, images, jobs, last_run, phantoms, scanner, storage, volumes
from ..addon.decimals import typed
from ..addon.projection_properties import ProjectionSettings, chosen_model
from ..core.errors import InputError
from ..core.geometry.system import PinholeSystem
from ..core.memory import require
from ..core.progress import Progress
from ..core.runs.run import ProjectionRun
from ..core.volumes.volume import require_quantity


class MPHDRR_OT_render_projections(ProjectionSettings, jobs.JobOperator, bpy.types.Operator):
    bl_idname = ids.RENDER_PROJECTIONS
    bl_label = "Render Projections"
    bl_description = (
        "Project the volume into every module: exact line integrals or SPECT counts, stored as images and as a file "
        "beside the .blend. Settings that a script leaves out are those of the panel"
    )
    bl_options = {"REGISTER", "UNDO"}

    volume: StringProperty(name="Volume", description="Name of the volume object to project", options={"SKIP_SAVE"})
    mu: StringProperty(
        name="Attenuation", description="Name of the volume object of attenuation coefficients", options={"SKIP_SAVE"}
    )
    opening_angle: FloatProperty(
        name="Opening Angle", description="Full angle of the knife edge's cone, instead of the scanner's",
        subtype="ANGLE", default=math.pi / 2, min=0.01, max=3.1, options={"SKIP_SAVE"},
    )  # fmt: skip

    def job(self, context: bpy.types.Context) -> jobs.Job:
        scene = context.scene
        collection = scanner.required_scanner(scene)
        chosen = {name: self._setting(scene, name) for name in ProjectionSettings.__annotations__}
        own_angle = self.properties.is_property_set("opening_angle")
        chosen["opening_angle"] = self.opening_angle if own_angle else collection.mphdrr_scanner.opening_angle
        system = _range(scanner.read_scanner(collection), chosen["first"], chosen["last"])
        shape = (chosen["height"], chosen["width"])
        model = chosen_model(chosen, system)  # what cannot be is said before the work begins
        counts = chosen["model"] == "EMISSION"
        photons = typed(chosen["photons"]) if chosen["model"] == "TRANSMISSION" and chosen["photons"] else None
        noise_seed = chosen["seed"] if chosen["noise"] and (counts or photons) else None
        item = _chosen_volume(context, self.volume, ("mu",) if photons else model.takes, model.name)
        mu = _chosen_mu(context, self.mu) if counts else None
        read_mu = None if mu is None else volumes.reader(mu)
        read_volume = volumes.reader(item)
        for volume in (item, mu):
            if volume is not None:
                phantoms.require_current(volume)
        energy = None if mu is None else phantoms.mu_energy(mu)
        n_bytes = 4.0 * len(system) * shape[0] * shape[1]
        # The array, and Blender's images with four channels in memory and once more, packed.
        require(9 * n_bytes, f"{len(system)} images of {shape[1]} x {shape[0]} pixels")
        path = storage.folder() / f"{bpy.path.clean_name(scene.name)}-projections.h5"
        settings: dict[str, Any] = {"volume": item.name} | ({} if mu is None else {"mu_volume": mu.name})
        phantom = phantoms.settings_of(item)
        if phantom is not None:
            settings |= phantom.recipe()
        if item.data.is_sequence:
            settings |= {"frame": scene.frame_current, "state": volumes.state_text(item)}
        scene_name, item_name, start = scene.name, item.name, time.perf_counter()
        mu_name = None if mu is None else mu.name

        def work(progress: Progress) -> ProjectionRun:
            from ..core.runs.files import write_run
            from ..core.runs.projecting import project_run, warn_of_energy

            progress(0, len(system))
            if mu_name is not None and energy is not None:
                warn_of_energy(model, energy, f"the mu of {mu_name!r}")
            run = project_run(
                system,
                read_volume(),
                model=chosen_model(chosen, system, None if read_mu is None else read_mu()),
                shape=shape,
                detector=chosen["detector"].lower(),
                magnification=typed(chosen["magnification"]),
                backend=chosen["backend"].lower(),
                settings=settings,
                photons=photons,
                noise_seed=noise_seed,
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
            last_run.record_run(scene, run, path)
            seconds = time.perf_counter() - start
            where = path if bpy.data.filepath else f"{path} until the .blend is saved"
            return f"Projected {item_name!r} into {len(run.views)} modules in {seconds:.1f} s: {where}"

        return jobs.Job("Projecting", work, finish)

    def _setting(self, scene: bpy.types.Scene, name: str) -> Any:
        """A setting as given to the operator, else the panel's; a coefficient that is given is not the panel's material."""
        coefficient = name.replace("_material", "_mu")
        if not self.properties.is_property_set(name) and self.properties.is_property_set(coefficient):
            return "NUMBER"
        return getattr(self if self.properties.is_property_set(name) else getattr(scene, ids.SCENE_PROJECTIONS), name)


class MPHDRR_OT_show_projections(bpy.types.Operator):
    bl_idname = ids.SHOW_PROJECTIONS
    bl_label = "Show Projections"
    bl_description = "Show the mosaic of the last run in an Image Editor, opened below the 3D view if there is none"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if ids.MOSAIC not in bpy.data.images:
            cls.poll_message_set("No projections yet: render them first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        if not images.show_below(bpy.data.images[ids.MOSAIC], context):
            self.report({"ERROR"}, "no window with a 3D view to open an Image Editor in")
            return {"CANCELLED"}
        return {"FINISHED"}


def _range(system: PinholeSystem, first: int, last: int) -> PinholeSystem:
    """The modules numbered `first` to `last`; 0 leaves an end open."""
    numbers = system.numbers
    chosen = (numbers >= first) & (numbers <= (last or numbers.max()))
    if not chosen.any():
        raise InputError(
            f"no module is numbered {first} to {last or numbers.max()}: this scanner has {numbers.min()} to {numbers.max()}"
        )
    return system[chosen]


def _chosen_volume(context: bpy.types.Context, name: str, taken: Sequence[str], model: str) -> bpy.types.Object:
    """The volume named, else the panel's, else the active one, else the only one of a quantity that the model takes."""
    known = volumes.volume_objects(context.scene)
    chosen = _named(known, name) if name else _of_panel(context, "volume")
    # A CT that is active is meant, though it has to be converted first; of other volumes a fitting one is looked for.
    if chosen is None and context.object in known and "mu" in taken and volumes.quantity_of(context.object) == "hu":
        chosen = context.object
    if chosen is not None:
        require_quantity(volumes.quantity_of(chosen), taken, f"{chosen.name!r} for {model}")
        return chosen
    fitting = [item for item in known if volumes.quantity_of(item) in taken]
    if context.object in fitting:
        return context.object
    what = " or ".join(taken)
    if not fitting:
        raise InputError(f"no volume of {what} in the scene: add a phantom first")
    if len(fitting) > 1:
        raise InputError(f"choose what to project: there are {len(fitting)} volumes of {what}")
    return fitting[0]


def _chosen_mu(context: bpy.types.Context, name: str) -> bpy.types.Object | None:
    """The volume of attenuation coefficients named, else the panel's, else None."""
    chosen = _named(volumes.volume_objects(context.scene), name) if name else _of_panel(context, "mu")
    if chosen is not None:
        require_quantity(volumes.quantity_of(chosen), ("mu",), f"{chosen.name!r} for attenuation")
    return chosen


def _of_panel(context: bpy.types.Context, name: str) -> bpy.types.Object | None:
    """The panel's volume, if it has one. Blender keeps one there that the user has deleted."""
    settings = getattr(context.scene, ids.SCENE_PROJECTIONS)
    chosen = getattr(settings, name)
    if chosen is not None and chosen not in volumes.volume_objects(context.scene):
        label = settings.bl_rna.properties[name].name
        raise InputError(f"{label} {chosen.name!r} is not in this scene any more: choose another, or none")
    return chosen


def _named(known: list[bpy.types.Object], name: str) -> bpy.types.Object:
    for item in known:
        if item.name == name:
            return item
    raise InputError(f"no volume is named {name!r}; there are: {', '.join(item.name for item in known) or 'none'}")
