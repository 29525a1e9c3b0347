"""Table of the backends, ways to compute line integrals, with what they need, and the choice of "auto".

A backend is a row of `BACKENDS` and a module with four functions. Line integrals are
``L int_0^1 f(alpha) exp(-L int_0^alpha mu) dalpha`` with L the ray's length in mm, f the volume and mu the attenuation
coefficient, if there is any.

- ``forward(volume, rays, attenuation=None)`` returns them, (N,).
- ``backproject(volume, values, rays, attenuation=None)`` adds the values to the volume in place, each along its ray with
  the same weights.
- ``derivatives(volume, rays, attenuation=None)`` returns (N, 7): the integral over alpha (the line integral per mm of
  L), and its derivatives by the ray's start (3) and end (3) in index space. With attenuation (N, 14): the derivatives
  [1:7] are those through the planes of the volume, where f jumps, then follow [7:13] by start and end in mu's index
  space, through its planes, where mu jumps (also where mu shares the volume's lattice), all at constant L; and [13] by
  L, at constant ends.
- ``mu_gradient(gradient, volume, values, rays, attenuation)`` adds to `gradient` (of mu's shape) in place the sum over
  the rays of their values times the derivative of the line integral by mu.

`rays` are `IndexRays` or `IndexFans`, attenuation is an `Attenuation`; volumes, values, mu and gradients are of the kind
that the backend's `to_backend` returns.
"""

import functools
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from ...arrays import ArrayOrTensor, to_numpy, to_tensor
from ...errors import InputError, first_line, install_advice, warn


@dataclass(frozen=True)
class Backend:
    """A way to compute line integrals, and how it wants its rays."""

    name: str
    """Name in settings."""
    label: str
    """Label in menus."""
    text: str
    """Short description for menus."""
    module: str
    """Name of the module, in this package, with its functions."""
    rays_at_once: int
    """Number of rays of a call: large enough that calls take little time, small enough that arrays stay in the cache."""
    rays_of_images: int
    """Number of rays up to which several small images are traced in one call."""
    to_backend: Callable[[ArrayOrTensor, bool], ArrayOrTensor]
    """Conversion of an array or tensor, float64 or else float32, to the kind that the functions take."""
    own_threads: bool = False
    """Whether a call uses the whole machine by itself; other backends are called on several threads."""
    always_float64: bool = False
    """Whether it computes in float64 also from float32."""

    @property
    def functions(self) -> ModuleType:
        """Module with the four functions."""
        return load(self.module)

    def workers(self, threads: int) -> int:
        """Return the number of `threads` that call the backend at the same time."""
        return 1 if self.own_threads else threads


def load(module: str) -> ModuleType:
    """Return a module of this package; libraries are imported when a backend is first used."""
    return importlib.import_module(f".{module}", __package__)


def _array(x: ArrayOrTensor, float64: bool) -> ArrayOrTensor:
    """Return `x` as a NumPy array of float32 or, with `float64`, of float64."""
    return to_numpy(x, np.float64 if float64 else np.float32)


def _tensor(x: ArrayOrTensor, float64: bool) -> ArrayOrTensor:
    """Return `x` as a tensor on its device; of float64 with `float64`, else in its own type."""
    tensor = to_tensor(x)
    return tensor.double() if float64 else tensor


def _on_gpu(x: ArrayOrTensor, float64: bool) -> ArrayOrTensor:
    """Return `x` as a tensor of float32 on the GPU."""
    return load("cuda").to_backend(x)


# torch is slow on a CPU, so its calls for several small images are short: between calls a job can stop.
_ROWS = (
    Backend("cpu", "CPU", "Compiled, on the processor", "cpu", 2**14, 2**14, _array),
    Backend("torch", "PyTorch", "On the processor or the graphics card", "reference", 2**18, 2**12, _tensor, True),
    Backend("numpy", "NumPy", "Float64 reference, slow", "reference", 2**12, 2**12, _array, False, True),
    Backend("cuda", "CUDA", "On an NVIDIA graphics card; needs warp-lang and torch", "cuda", 2**22, 2**22, _on_gpu, True),
)  # fmt: skip
BACKENDS = {backend.name: backend for backend in _ROWS}
"""Backends by name."""

_AUTOMATIC = ("cpu", "torch", "numpy")
"""Backends that "auto" chooses from for arrays, in order of preference; for a tensor on a GPU see `for_tensor`."""

OLD_NAMES = {"numba": "cpu"}
"""Present names of backends by their names in files and scripts of version 0.1."""

_PACKAGES = {"torch": "torch", "cuda": "warp-lang torch"}

# A library may be absent, not be made for this platform, or fail to load its binaries.
_CANNOT_LOAD = (ImportError, OSError)


def choose(name: str) -> Backend:
    """Return the backend that `name` ("auto", one of `BACKENDS` or an old name) stands for on this machine, loaded.

    Raises
    ------
    InputError
        There is no such backend, or the library or the GPU that it needs is missing.
    """
    name = OLD_NAMES.get(name, name)
    if name == "auto":
        return _automatic()
    if name not in BACKENDS:
        raise InputError(f"backend {name!r}: expected one of auto, {', '.join(BACKENDS)}")
    backend = BACKENDS[name]
    try:
        _require(backend)
    except _CANNOT_LOAD as error:
        remedy = f": {install_advice(_PACKAGES[name])}" if name in _PACKAGES else ""
        raise InputError(f"backend {name!r} cannot be used ({first_line(error)}){remedy}") from None
    return backend


def _automatic() -> Backend:
    """Return the first backend of `_AUTOMATIC` that can be used, with a warning if it is not the first of all."""
    reason = ""
    for name in _AUTOMATIC:
        try:
            _require(BACKENDS[name])
        except _CANNOT_LOAD as error:
            reason = reason or first_line(error)
            continue
        if reason:
            _warn_slower(name, reason)
        return BACKENDS[name]
    raise AssertionError("numpy is always there")


def _require(backend: Backend) -> None:
    """Load the libraries and the device that a backend needs; raise an error where they are missing."""
    if backend.name == "torch":
        importlib.import_module("torch")
    functions = backend.functions
    if hasattr(functions, "device"):
        functions.device()


def for_tensor(tensor: Any) -> Backend:
    """Return the backend of "auto" for a tensor that is not on the CPU: "cuda" where that works, else "torch"."""
    return BACKENDS["cuda" if tensor.is_cuda and _cuda_works() else "torch"]


@functools.cache
def _cuda_works() -> bool:
    """Return whether the backend "cuda" can be used on this machine."""
    return not _problem("cuda")


def _problem(name: str) -> str:
    """Return the reason why a backend cannot be used on this machine, "" if it can; its libraries are loaded for this."""
    try:
        _require(BACKENDS[name])
    except (InputError, *_CANNOT_LOAD) as error:
        return first_line(error)
    return ""


@functools.cache
def states() -> dict[str, str]:
    """Return the state of each backend on this machine in words: used by "auto", available, or why it is not."""
    problems = {name: _problem(name) for name in BACKENDS}
    automatic = next(name for name in _AUTOMATIC if not problems[name])
    texts = {name: f"not found: {problem}" if problem else "found, can be chosen" for name, problem in problems.items()}
    return {**texts, automatic: "found, used automatically"}


@functools.cache
def _warn_slower(name: str, reason: str) -> None:
    """Warn, once, that projections run with a slower backend."""
    warn(f"projections run with {name}, many times slower than with the backend cpu ({reason})", 5)
