"""The backend cuda: Siddon's line integrals on an NVIDIA GPU, one thread per ray, several views per launch.

The kernels are in `warp_kernels`. No GPU has run them yet: docs/gpu.md tells what was tested, and how. Derivatives are those
of `reference`, in torch on the same device.

NVIDIA Warp has one wheel for each of Linux, Windows and macOS without bounds on numpy, which brings its own compilers
and runs the very same kernels on the CPU, where they are tested. Triton has no official wheel for Windows, and its programs
work on blocks, not on single rays.

The volume is on the device as a whole. The rays are computed there, from their fans; they are launched in pieces that leave
half of the free memory alone. Arrays become tensors on the device; tensors stay where they are, on torch's stream.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp
from torch import Tensor

from ... import cache
from ...arrays import ArrayOrTensor, Floats, is_tensor, to_caller, to_numpy, to_tensor
from ...errors import InputError, first_line
from ...memory import readable_size
from ..ray_geometry import Attenuation, IndexRays, Rays
from . import reference

DEVICE_VARIABLE = "MPHDRR_CUDA_DEVICE"
"""Environment variable with the Warp device for arrays, by default "cuda"; "cpu" runs the kernels without a GPU."""

_RAYS_AT_ONCE = 2**24
_FEWEST_RAYS = 2**14  # some megabytes, also if there seems to be less: torch may hold memory that it does not use
_BYTES_OF_A_FAN = 2 * 9 * 24  # in the index space of the volume and of mu
_BYTES_OF_A_PLANE = 2**31  # Warp's strides are 32 bits wide; offsets are 64

_ROOM_FOR_KERNELS = 16 * 2**20

_loading = threading.Lock()
_loaded: set[str] = set()


def forward(volume: ArrayOrTensor, rays: Rays, attenuation: Attenuation | None = None) -> ArrayOrTensor:
    """Return line integrals (N,), value x mm, of `volume` (n_x, n_y, n_z), attenuated towards the rays' sources."""
    with _Call(to_backend(volume), rays, _on_device(attenuation)) as call:
        return to_caller(call.integrals(), volume)


def backproject(
    volume: ArrayOrTensor, values: ArrayOrTensor, rays: Rays, attenuation: Attenuation | None = None
) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place, in no fixed order."""
    total = to_backend(volume)
    with _Call(total, rays, _on_device(attenuation)) as call:
        call.add(to_backend(values))
    if not is_tensor(volume):
        volume[...] = to_caller(total, volume)


def derivatives(volume: ArrayOrTensor, rays: Rays, attenuation: Attenuation | None = None) -> ArrayOrTensor:
    """Return the integrals' derivatives by the ends of `rays`, (N, 7) or (N, 14): those of the reference, on the device."""
    return to_caller(reference.derivatives(to_backend(volume), rays, _on_device(attenuation)), volume)


def mu_gradient(
    gradient: ArrayOrTensor, volume: ArrayOrTensor, values: ArrayOrTensor, rays: Rays, attenuation: Attenuation
) -> None:
    """Add the gradient by mu of the sum of `values` (N,) times the integrals to `gradient` in place, on the device."""
    total, mu = to_backend(gradient), replace(attenuation, mu=to_backend(attenuation.mu))
    reference.mu_gradient(total, to_backend(volume), to_backend(values), rays, mu)
    if not is_tensor(gradient):
        gradient[...] = to_caller(total, gradient)


def _on_device(attenuation: Attenuation | None) -> Attenuation | None:
    """Return an attenuation with mu on the device."""
    return None if attenuation is None else replace(attenuation, mu=to_backend(attenuation.mu))


def to_backend(x: ArrayOrTensor) -> ArrayOrTensor:
    """Return `x` as a tensor of float32 on the device; one that is there already is not copied."""
    if is_tensor(x) and (x.is_cuda or (x.device.type == "cpu" and device().is_cpu)):
        return x.detach().float().resolve_neg().contiguous()  # Warp does not see torch's lazy minus sign
    array, target = to_numpy(x, np.float32), device()
    if array.nbytes > target.free_memory:
        size, free = readable_size(array.nbytes), readable_size(target.free_memory)
        raise InputError(f"backend 'cuda': {size} of numbers, but {free} are free on {target.name}")
    return to_tensor(array).to(wp.device_to_torch(target))


def device() -> Any:
    """Return the device for arrays (a `warp.Device`).

    Raises
    ------
    InputError
        This machine has no NVIDIA GPU, or no driver for it.
    """
    name = os.environ.get(DEVICE_VARIABLE, "cuda")
    if name != "cpu" and not has_driver():
        raise InputError("backend 'cuda': no NVIDIA driver found on this machine; use backend 'auto' or 'cpu'")
    with _loading, _quiet():
        _initialize()
        try:
            return wp.get_device(name)
        except (RuntimeError, ValueError) as error:
            raise InputError(f"backend 'cuda': no NVIDIA GPU that can be used ({name}: {first_line(error)})") from None


def has_driver() -> bool:
    """Return whether there is NVIDIA's driver; Warp complains on standard error if it has to find that out by itself."""
    names = ("nvcuda.dll",) if sys.platform == "win32" else ("libcuda.so", "libcuda.so.1")
    return any(map(_loads, names))


@functools.cache
def _loads(library: str) -> bool:
    """Return whether a library of this name can be loaded."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


class _Call:
    """Call of the backend: volume, rays and attenuation on the device, and launches of the kernels."""

    def __init__(self, volume: Tensor, rays: Rays, attenuation: Attenuation | None) -> None:
        self._device = wp.device_from_torch(volume.device)
        self._stream = wp.ScopedStream(wp.stream_from_torch(volume.device)) if volume.is_cuda else nullcontext()
        self._volume = volume
        self._kernels = _kernels(self._device)
        self._fans, self._rows, self._columns = _table(rays)
        self._attenuation = attenuation
        has_lattice = attenuation is not None and attenuation.rays is not None
        self._mu_fans = _table(attenuation.rays)[0] if has_lattice else None  # type: ignore[union-attr, arg-type]

    def __enter__(self) -> _Call:
        self._stream.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: Any) -> None:
        self._stream.__exit__(kind, error, traceback)
        if isinstance(error, RuntimeError) and "Failed to allocate" in str(error):
            free = readable_size(self._device.free_memory)
            raise InputError(f"backend 'cuda': {self._device.name} has too little free memory, {free}") from error

    def integrals(self) -> Tensor:
        """Return the line integrals (N,)."""
        result = self._volume.new_empty((len(self._fans), self._rows, self._columns))
        self._launch(self._kernels.integrate, result)
        return result.reshape(-1)

    def add(self, values: Tensor) -> None:
        """Add the rays' `values` (N,) to the volume."""
        self._launch(self._kernels.backproject, values.reshape(len(self._fans), self._rows, self._columns))

    def _launch(self, kernel: Any, numbers: Tensor) -> None:
        """Launch a kernel on the rays and their `numbers`, piece by piece; without mu the volume stands in its place."""
        volumes = [_array(self._volume if x is None else x.mu) for x in (None, self._attenuation)]
        for fans, rows in self._pieces():
            rays = wp.array(self._fans[fans], dtype=wp.vec3d, device=self._device)
            mu_rays, attenuated = rays, int(self._attenuation is not None)
            if self._mu_fans is not None:
                mu_rays, attenuated = wp.array(self._mu_fans[fans], dtype=wp.vec3d, device=self._device), 2
            piece = numbers[fans, rows]
            inputs = [*volumes, rays, mu_rays, attenuated, rows.start, wp.from_torch(piece)]
            wp.launch(kernel, tuple(piece.shape), inputs=inputs, device=self._device)

    def _pieces(self) -> Iterator[tuple[slice, slice]]:
        """Yield the fans, and their rows, that are launched together."""
        pixels = self._rows * self._columns
        affordable = max(_FEWEST_RAYS, int(self._device.free_memory / 2 / (4 + _BYTES_OF_A_FAN / pixels)))
        at_once = min(_RAYS_AT_ONCE, affordable)
        fans = max(1, at_once // pixels)
        rows = self._rows if fans > 1 else min(self._rows, max(1, at_once // self._columns))
        for fan in range(0, len(self._fans), fans):
            for row in range(0, self._rows, rows):
                yield slice(fan, min(fan + fans, len(self._fans))), slice(row, min(row + rows, self._rows))


def _array(volume: Tensor) -> Any:
    """Return a tensor on the device as Warp's array, without a copy."""
    if volume.shape[1] * volume.shape[2] * 4 >= _BYTES_OF_A_PLANE:
        raise InputError(f"backend 'cuda': {volume.shape[1]} x {volume.shape[2]} voxels a plane are too many")
    return wp.from_torch(volume)


def _table(rays: Rays) -> tuple[Floats, int, int]:
    """Return rays as the kernels take them: fans (F, 9, 3), their rows and columns. A listed ray is a fan of one ray."""
    table = np.zeros((len(rays) if isinstance(rays, IndexRays) else len(rays.table), 9, 3))
    if isinstance(rays, IndexRays):
        table[:, 0] = rays.starts
        table[:, 1] = rays.starts + rays.directions
        table[:, 5, 0] = rays.lengths
        return table, 1, 1
    table[:, :8] = rays.table
    if rays.parallel:
        table[:, 6:8], table[:, 8] = 0.0, 1.0
    return table, *rays.shape


def _kernels(device: Any) -> ModuleType:
    """Return the kernels, compiled for `device`, from the cache on disk if possible."""
    from . import warp_kernels

    with _loading:
        if device.alias not in _loaded:
            with _quiet():
                try:
                    wp.load_module(warp_kernels, device=device)
                except Exception:  # of a full disk or a damaged file: compiled anew they need no cache
                    wp.config.kernel_cache_dir = _scratch_folder()
                    wp.get_module(warp_kernels.__name__).unload()
                    wp.load_module(warp_kernels, device=device)
            _loaded.add(device.alias)
    return warp_kernels


def _initialize() -> None:
    """Start Warp with its cache in `cache.folder`, unless the user has chosen another or has started it already."""
    if wp.config.kernel_cache_dir is None and "WARP_CACHE_PATH" not in os.environ:
        folder = str(cache.folder() / "warp")
        try:
            os.makedirs(folder, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            if shutil.disk_usage(folder).free < _ROOM_FOR_KERNELS:  # on a full disk Warp's compiler aborts
                folder = _scratch_folder()
        except OSError:
            folder = _scratch_folder()
        wp.config.kernel_cache_dir = folder
    wp.init()


@functools.cache
def _scratch_folder() -> str:
    """Return a temporary folder that is removed when Python ends."""
    folder = tempfile.mkdtemp(prefix="mphdrr-warp-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Warp's messages but for warnings; it reports every start and every module."""
    level = wp.config.log_level
    wp.config.log_level = max(level, wp.LOG_WARNING)
    try:
        yield
    finally:
        wp.config.log_level = level
