"""The backend cpu: Siddon's line integrals in C, the default on a processor.

The kernels are in `kernels`, compiled for each platform and for the levels of its processors; ``kernels.h`` is the contract.
They run in the thread that calls, without the GIL: `Execution` calls them on several threads. Volumes of float64 are traced
in float64, all others in float32. The same library has the kernels of `pinhole_response.compiled` and of
`perspective.places`.
"""

import ctypes
import os
import sys
from ctypes import POINTER, Structure, c_char_p, c_double, c_int64, c_uint64, c_void_p
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array, Floats
from ...errors import InputError
from ...validation import shape_text
from ..ray_geometry import Attenuation, IndexFans, IndexRays, Rays

LEVEL_VARIABLE = "MPHDRR_CPU_LEVEL"
"""Environment variable with the name of a lower level of processor, of `levels`, than this one's."""

_CONTRACT = 13
_NAMES = {"win32": "siddon.dll", "darwin": "libsiddon.dylib"}
_MAX_VOXELS = 2**31 - 1  # their indices have 32 bits
_PRODUCT = 2  # in kernels.h
_MAX_ELEMENTS_ALONG = 2**16  # where float32 knows a place to 1/256 of an element; beyond 2^24 it would miss whole ones
_MAX_VOXELS_ALONG = 2**12  # where float32 knows the length of a segment to 0.1 %

_FAN = np.dtype([
    ("volume", "(4,3)f8"), ("mu", "(4,3)f8"), ("world", "(3,3)f8"), ("rows", "i8"), ("columns", "i8"),
    ("parallel", "f8"),
])  # fmt: skip


class VoxelArray(Structure):
    """An array of voxels, as kernels.h has it: `Lattice`."""

    _fields_ = [("voxels", c_void_p), ("n", c_int64 * 3)]


class _RayList(Structure):
    """Rays one by one, as kernels.h has them: `RayList`."""

    _fields_ = [(name, c_void_p) for name in ("starts", "directions", "mu_starts", "mu_directions", "lengths")]
    _fields_ += [("count", c_int64)]


class _Job(Structure):
    """A job of line integrals, as kernels.h has it: `Job`."""

    _fields_ = [
        ("is_double", c_int64), ("attenuation", c_int64), ("volume", VoxelArray), ("mu", VoxelArray),
        ("fans", c_void_p), ("n_fans", c_int64), ("list", _RayList),
        ("values", c_void_p), ("integrals", c_void_p), ("derivatives", c_void_p), ("gradient", c_void_p),
    ]  # fmt: skip


class DepthJob(Structure):
    """A job of the depth-dependent pinhole response, as kernels.h has it."""

    _fields_ = [
        ("is_double", c_int64), ("volume", VoxelArray), ("first", c_int64), ("last", c_int64), ("matrix", c_double * 12),
        ("line", c_double * 3), ("shifts", c_void_p), ("pieces", c_int64), ("of_point", c_double), ("of_pair", c_double),
        ("parts_per_cell", c_double), ("nearest", c_double), ("farthest", c_double), ("first_plane", c_double),
        ("planes_per_inverse", c_double), ("passes", c_void_p), ("cells", c_void_p), ("planes", c_int64),
        ("rows", c_int64), ("columns", c_int64), ("kernel", c_void_p), ("bounds", c_void_p),
        ("taps", c_int64 * 2), ("step", c_int64 * 2), ("image", c_void_p), ("row", c_int64), ("pixels", c_int64 * 2),
        ("nodes", c_int64 * 2), ("node_rows", c_void_p), ("node_columns", c_void_p), ("room", c_void_p),
        ("columns_of", c_void_p), ("gradient", c_void_p),
    ]  # fmt: skip


class PlacesJob(Structure):
    """A job of the interpolation at the places of another lattice, as kernels.h has it."""

    _fields_ = [
        ("is_double", c_int64), ("how", c_int64), ("flat", c_int64), ("by_depth", c_int64), ("points", c_void_p),
        ("n", c_int64 * 3), ("first", c_int64), ("last", c_int64), ("planes", c_void_p), ("middle", c_double),
        ("nearest", c_double), ("values", c_void_p), ("arrays", c_int64), ("m", c_int64 * 3), ("matrices", c_void_p),
        ("seen", c_void_p), ("exponents", c_void_p),
    ]  # fmt: skip


class PhotonJob(Structure):
    """A job of photons that scatter, as kernels.h has it."""

    _fields_ = [
        ("is_double", c_int64), ("body", c_void_p), ("n", c_int64 * 3), ("index_from_world", c_double * 12),
        ("energies", c_int64), ("lowest", c_double), ("energies_per_kev", c_double), ("coefficients", c_void_p),
        ("momenta", c_int64), ("momenta_per_root", c_double), ("incoherent", c_void_p), ("coherent", c_void_p),
        ("coherent_until", c_void_p), ("seed", c_uint64), ("all_first", c_int64), ("first", c_int64),
        ("last", c_int64), ("starts", c_void_p), ("collisions", c_void_p), ("capacity", c_int64),
        ("followed", c_void_p), ("n_collisions", c_void_p), ("holes", c_void_p), ("modules", c_int64),
        ("first_module", c_int64), ("last_module", c_int64), ("accepted", c_void_p), ("worth", c_void_p),
        ("windows", c_int64), ("orders", c_int64), ("cell_of", c_void_p), ("cells", c_int64), ("seen", c_void_p),
        ("totals", c_void_p), ("spectra", c_void_p), ("panel", c_void_p),
    ]  # fmt: skip


START = np.dtype([
    ("place", "3f8"), ("direction", "3f8"), ("energy", "f8"), ("collides_at", "f8"), ("weight", "f8"),
])  # fmt: skip
"""A photon that begins, as kernels.h has it: `Start`."""
MODULE = np.dtype([
    ("hole", "3f8"), ("u", "3f8"), ("v", "3f8"), ("axis", "3f8"), ("slopes", "4f8"), ("margin", "f8"),
    ("margin_by_height", "f8"), ("nearest", "f8"), ("area", "f8"),
    ("least", "f8"),
])  # fmt: skip
"""A module that sees photons, as kernels.h has it: `Module`."""
PANEL = np.dtype([
    ("corner", "3f8"), ("u", "3f8"), ("v", "3f8"), ("area", "3f8"), ("columns", "i8"), ("rows", "i8"), ("places", "i8"),
])  # fmt: skip
"""A panel that sees photons, as kernels.h has it: `Panel`."""
COLLISION = np.dtype([
    ("place", "3f8"), ("direction", "3f8"), ("energy", "f8"), ("weight", "f4"), ("voxel", "i4"), ("order", "i4"),
], align=True)  # fmt: skip
"""A collision of a photon, as kernels.h has it: `Collision`."""
MOST_COLLISIONS = 64  # in kernels.h

_KERNELS = {
    _Job: ("forward", "backproject", "differentiate", "differentiate_by_mu"),
    DepthJob: ("voxels_to_cells", "cells_to_voxels", "cells_to_pixels", "pixels_to_cells",
               "differentiate_places", "differentiate_taps"),
    PlacesJob: ("take_at", "give_at"),
    PhotonJob: ("follow", "see", "see_panel"),
}  # fmt: skip


def _load() -> ctypes.CDLL:
    """Return the library in this package; raise `ImportError` if there is none, or one of another version."""
    path = Path(__file__).with_name("kernels") / _NAMES.get(sys.platform, "libsiddon.so")
    if not path.is_file():
        raise ImportError(f"no compiled kernels for this platform: {path.name} is not in {path.parent}")
    library = ctypes.CDLL(str(path))
    numbers = (c_int64 * 6)()
    library.contract(numbers)
    sizes = (ctypes.sizeof(_Job), _FAN.itemsize, *map(ctypes.sizeof, (DepthJob, PlacesJob, PhotonJob)))
    if tuple(numbers) != (_CONTRACT, *sizes):
        raise ImportError(f"{path} belongs to another version of mphDRR: install it anew")
    library.best_level.restype, library.level_name.restype = c_int64, c_char_p
    library.level_name.argtypes = [c_int64]
    for job, names in _KERNELS.items():
        for name in names:
            function = getattr(library, name)
            function.argtypes, function.restype = [c_int64, POINTER(job)], None
    return library


library = _load()


def levels() -> list[str]:
    """Return the names of the levels of kernels that this processor supports, the lowest first."""
    return [library.level_name(level).decode() for level in range(library.best_level() + 1)]


def _level() -> int:
    """Return the index of the level in the environment variable, or of the highest one."""
    names, name = levels(), os.environ.get(LEVEL_VARIABLE)
    if name and name not in names:
        raise InputError(f"{LEVEL_VARIABLE}: expected a level that this processor has, {', '.join(names)}; got {name}")
    return names.index(name) if name else len(names) - 1


level = _level()
"""Level of the kernels that are used, an index of `levels`."""


def forward(volume: Array, rays: Rays, attenuation: Attenuation | None = None) -> Array:
    """Return line integrals (N,), value x mm, of `volume` (n_x, n_y, n_z), attenuated towards the rays' sources."""
    values = np.empty(len(rays), volume.dtype)
    _run(library.forward, volume, rays, attenuation, values)
    return values


def backproject(volume: Array, values: Array, rays: Rays, attenuation: Attenuation | None = None) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place."""
    _run(library.backproject, volume, rays, attenuation, values)


def derivatives(volume: Array, rays: Rays, attenuation: Attenuation | None = None) -> Array:
    """Return the integrals' derivatives by the ends of `rays`, (N, 7) or (N, 14), as `backends` describes them."""
    integrals = None if attenuation is None else forward(volume, rays, attenuation)
    result = np.empty((7 if attenuation is None else 14, len(rays)))
    _run(library.differentiate, volume, rays, attenuation, integrals=integrals, derivatives=result)
    return result.T


def mu_gradient(gradient: Array, volume: Array, values: Array, rays: Rays, attenuation: Attenuation) -> None:
    """Add the gradient by mu of the sum of `values` (N,) times the integrals to `gradient`, of mu's shape, in place."""
    integrals = forward(volume, rays, attenuation)
    _run(library.differentiate_by_mu, volume, rays, attenuation, values, integrals=integrals, gradient=gradient)


def gather(
    points: Array,
    planes: Floats,
    arrays: Array,
    matrices: Floats,
    mode: int,
    counts: Any,
    exponents: Any,
    **fields: Any,
) -> None:
    """Combine `points` in place with the values of `arrays` at their places, as `perspective.places.gather` describes it."""
    integers = [array for array in (counts, exponents) if array is not None]
    if any(array.dtype != np.int32 or array.shape != points.shape for array in integers):
        raise TypeError("expected counts of int32 and of the points' shape")
    if mode == _PRODUCT and exponents is None:
        raise ValueError("expected exponents, which a product needs")
    fields |= {"seen": None if counts is None else counts.ctypes.data, "how": mode, "last": len(points)}
    fields["exponents"] = None if exponents is None else exponents.ctypes.data
    _run_places(library.take_at, points, planes, arrays, matrices, [points, *integers], **fields)


def scatter(points: Array, planes: Floats, array: Array, matrix: Floats, slab: slice) -> None:
    """Add the adjoint of `gather`'s sum to the `slab` of `array` along its first axis, in place."""
    first, last, _ = slab.indices(len(array))
    _run_places(library.give_at, points, planes, array[None], matrix[None], [array], first=first, last=last)


def _run_places(
    kernel: Any, points: Array, planes: Floats, arrays: Array, matrices: Floats, outputs: list[Array], **settings: Any
) -> None:
    """Run a kernel between points and arrays after checks of all arrays; `outputs` are those that it writes."""
    dtype, shape = points.dtype, arrays.shape[1:]
    if dtype not in (np.float32, np.float64) or arrays.dtype != dtype or matrices.dtype != np.float64:
        raise TypeError("expected points and arrays of one type, float32 or float64, and matrices of float64")
    is_c_order = all(array.flags.c_contiguous for array in (points, arrays, matrices, *outputs))
    if not is_c_order or not outputs[0].flags.writeable:
        raise ValueError("expected arrays in C order, that can be written")
    has_planes = planes.shape == points.shape[2:] and not (settings.get("flat") and shape[2] != 1)
    if matrices.shape != (len(arrays), 5, 4) or not has_planes:
        raise ValueError("expected a matrix (5, 4) for each array, a third coordinate for each plane of points")
    if not points.size or not arrays.size:
        return
    max_along = _MAX_ELEMENTS_ALONG if dtype == np.float32 else _MAX_VOXELS
    if arrays[0].size > _MAX_VOXELS or max(shape) > max_along:
        expected = f"an array of at most {_MAX_VOXELS} numbers, and {max_along} along an axis in {dtype}"
        raise InputError(f"expected {expected}; got {shape_text(shape)}")
    middle = float(planes[len(planes) // 2])
    relative = np.ascontiguousarray(planes - middle, dtype)
    job = PlacesJob(is_double=dtype == np.float64, points=points.ctypes.data, n=points.shape,
                    planes=relative.ctypes.data, middle=middle, values=arrays.ctypes.data, arrays=len(arrays), m=shape,
                    matrices=matrices.ctypes.data, **settings)  # fmt: skip
    kernel(level, job)


def _run(
    kernel: Any, volume: Array, rays: Rays, attenuation: Attenuation | None, values: Array | None = None, **arrays: Any
) -> None:
    """Run a kernel on all rays; `arrays` are further fields of the job."""
    mu, mu_rays = (None, None) if attenuation is None else (attenuation.mu, attenuation.rays)
    if values is not None:
        arrays["values"] = values = np.ascontiguousarray(values, volume.dtype)
        if len(values) != len(rays):
            raise ValueError(f"expected a value for each of {len(rays)} rays, got {len(values)}")
    if mu is not None and mu_rays is None and mu.shape != volume.shape:
        raise ValueError(f"expected mu on the volume's lattice {volume.shape}, got {mu.shape}")
    job = _Job(is_double=volume.dtype == np.float64, attenuation=0 if mu is None else 1 if mu_rays is None else 2,
               volume=as_voxel_array(volume, volume, kernel is library.backproject),
               mu=VoxelArray() if mu is None else as_voxel_array(mu, volume),
               **{name: array.ctypes.data for name, array in arrays.items() if array is not None})  # fmt: skip
    ray_arrays = [_fans(rays, mu_rays)] if isinstance(rays, IndexFans) else _columns(rays, mu_rays)
    addresses = [array.ctypes.data for array in ray_arrays]  # the arrays must live until the kernel is done
    if isinstance(rays, IndexFans):
        job.fans, job.n_fans = addresses[0], len(rays.table)
    else:
        job.list = _RayList(*addresses, len(rays))
    kernel(level, job)


def _columns(rays: IndexRays, mu_rays: Any) -> list[Array]:
    """Return starts and directions, also in mu's index space, and lengths, as the kernels take them."""
    columns = (column.T for listed in (rays, mu_rays or rays) for column in (listed.starts, listed.directions))
    return [np.ascontiguousarray(column) for column in (*columns, rays.lengths)]


def _fans(rays: IndexFans, mu_rays: Any) -> Array:
    """Return fans as the kernels take them."""
    fans = np.zeros(len(rays.table), _FAN)
    fans["volume"], fans["world"] = rays.table[:, :4], rays.table[:, 5:]
    fans["world"][:, 0] -= rays.table[:, 4]
    if mu_rays is not None:
        fans["mu"] = mu_rays.table[:, :4]
    fans["rows"], fans["columns"] = rays.shape
    fans["parallel"] = rays.parallel
    fans["world"][:, 1:] *= 1 - rays.parallel
    return fans


def as_voxel_array(voxels: Array, values: Array, is_output: bool = False) -> VoxelArray:
    """Return `voxels` as the kernels take them; raise an error if they are too many, or not of the type of `values`.

    Voxels that a kernel writes (`is_output`) must be writable.
    """
    max_along = _MAX_VOXELS_ALONG if voxels.dtype == np.float32 else _MAX_VOXELS
    if voxels.size > _MAX_VOXELS or max(voxels.shape) > max_along:
        limit = f"at most {_MAX_VOXELS}, and {_MAX_VOXELS_ALONG} along an axis in float32"
        message = f"{shape_text(voxels.shape)} voxels, but there can be {limit}"
        raise InputError(f"backend 'cpu': {message}; use the backend numpy")
    flags, dtype = voxels.flags, voxels.dtype
    has_type = dtype in (np.float32, np.float64) and dtype == values.dtype
    if not has_type or not flags.c_contiguous or is_output > flags.writeable:
        raise TypeError(f"expected C-ordered voxels of {values.dtype}, got {dtype}, strides {voxels.strides}")
    return VoxelArray(voxels.ctypes.data, voxels.shape)
