"""Volumes in rendered figures: closed surfaces in the colours of the values within them.

A surface renders in seconds where smoke takes minutes, and looks the same in every build of Blender: the Cycles of Debian's
draws no smoke.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce

import bpy
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import Progress, Volume, volume_to_mesh
from ...core.errors import InputError, warn
from ...core.runs.display import Display
from ...core.volumes.meshes.mesh import Mesh
from ...core.volumes.resampling import values_at
from ...core.volumes.volume import outside_value
from ..volumes import looks, slices, stored_volumes, volume_materials

_LEVEL = 0.25  # value of the surface of a volume that the window shows as smoke, as a fraction of its display range
_MAX_VOXELS = 160  # along each side; a finer volume is coarsened
_REACH = 3  # voxels to each side among which the highest value gives a vertex its colour


@dataclass(frozen=True)
class Ramp(Display):
    """Colours of a volume's display range, as its material has them."""

    ramp: volume_materials.Ramp = ()

    def colored(self, values: ArrayLike, window: tuple[float, float] | None = None) -> NDArray[np.uint8]:
        """Return the colours (..., 3) of `values`, uint8, from the ramp's first to last number in `window`."""
        table = np.rint(255 * slices.color_table("", self.ramp)[:, :3]).astype(np.uint8)
        return table[np.rint(255 * self.shares(values, window or self.window(values))).astype(int)]


@dataclass(frozen=True)
class Surface:
    """Surface of a volume at a value, with its colours and their range."""

    mesh: Mesh
    colors: NDArray[np.uint8]
    """Colours (V, 3) of the mesh's vertices, 8-bit sRGB."""
    display: Display
    window: tuple[float, float]
    """Values with the first and the last colour, in `unit`."""
    level: float
    """Value of the volume on the surface, in `unit`."""
    unit: str


def surface_maker(item: bpy.types.Object) -> Callable[[Volume, Progress], Surface]:
    """Return a function that makes the surface of an object's volume in its look, without bpy, for a worker thread.

    The surface is that of the look, cut as in the window, or of smoke at a quarter of the display range. A vertex has the
    colour of the highest value within three voxels, so that a rod has the colour of its core.
    """
    settings, factor = item.mphdrr_volume, volume_materials.display_unit(item.mphdrr_volume.quantity)[1]
    window, unit, name = (settings.display_low, settings.display_high), settings.unit, item.name
    display, n_surfaces = Ramp(ramp=volume_materials.item_ramp(item, smoke=True)), len(looks.surfaces_of(item))
    chosen_level = settings.surface if n_surfaces else window[0] + _LEVEL * (window[1] - window[0])
    cut = list(settings.slices) if n_surfaces == 1 and slices.planes_of(item) else None  # bones stand whole in the skin

    def make(volume: Volume, progress: Progress) -> Surface:
        """Return the surface of a volume in world mm."""
        outside, highest, level = outside_value(volume), float(volume.array.max()), chosen_level / factor
        if not outside < highest:
            raise InputError(f"{name!r} is empty: there is nothing to draw")
        if not outside < level <= highest:
            level = (outside + highest) / 2
            warn(f"the picture shows {name!r} at {level * factor:.3g} {unit}: Low and High draw none of its values")
        if cut is not None:
            volume = _cut_open(volume, cut)
        while max(volume.grid.shape) > _MAX_VOXELS:
            volume = stored_volumes.coarsen(volume)
        mesh = volume_to_mesh(volume, level, progress)
        peaks = volume.array
        for axis in range(3):
            peaks = reduce(np.maximum, (np.roll(peaks, step, axis) for step in range(-_REACH, _REACH + 1)))
        values = values_at(Volume(peaks, volume.grid, volume.quantity), mesh.vertices)
        return Surface(mesh, display.colored(factor * values, window), display, window, level * factor, unit)

    return make


def _cut_open(volume: Volume, indices: Sequence[int]) -> Volume:
    """Return a volume without the voxels in front of all three slices at `indices`."""
    normals, array = np.linalg.inv(volume.grid.affine)[:3, :3], volume.array.copy()
    sides = (normals @ slices.FRONT >= 0).tolist()
    front = tuple(slice(i + 1, None) if side else slice(i) for i, side in zip(indices, sides, strict=True))
    array[front] = outside_value(volume)
    return Volume(array, volume.grid, volume.quantity)
