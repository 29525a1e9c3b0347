"""Import paths of version 0.1.0 that documentation named, and where their modules are now."""

import importlib
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED = {
    "checks": "validation",
    "design": "geometry.design_formulas",
    "diffdrr": "exchange.diffdrr",
    "export": "runs.files",
    "frames": "geometry.frames",
    "geometry_checks": "geometry.checks",
    "geometry_export": "exchange",
    "grid": "geometry.grid",
    "hounsfield": "physics.ct_numbers",
    "isotopes": "physics.isotopes",
    "materials": "physics.materials",
    "mosaic": "runs.mosaic",
    "presets": "geometry.presets",
    "projector.siddon_cpu": "projector.backends.cpu",
    "registration": "projector.pose_search",
    "rotations": "geometry.rotations",
    "run": "runs.run",
    "system": "geometry.system",
    "views": "geometry.views",
    "volume": "volumes.volume",
    "volume_io": "volumes.volume_files",
}


class _OldPaths(MetaPathFinder, Loader):
    """Finds the modules of `MOVED`, and what is in them, by their old names, as the same module objects."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        old = name.removeprefix(f"{__package__}.")
        head = next((moved for moved in MOVED if f"{old}.".startswith(f"{moved}.")), None)
        if head is None or old == name:
            return None
        module = importlib.import_module(f".{MOVED[head]}{old.removeprefix(head)}", __package__)
        return ModuleSpec(name, self, loader_state=(module, module.__spec__))

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return spec.loader_state[0]

    def exec_module(self, module: ModuleType) -> None:
        """Leave the module as it was executed under its new name."""
        assert module.__spec__ is not None
        module.__spec__ = module.__spec__.loader_state[1]


def keep_old_paths() -> None:
    """Let ``import mphdrr.core.<old name>`` give the module that has its contents now; of the Python package only.

    An installed extension leaves Blender's imports alone, as its platform asks.
    """
    if __package__.startswith("bl_ext."):
        return
    sys.meta_path.insert(0, _OldPaths())  # before a path of packages finds the same file once more
