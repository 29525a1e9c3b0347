"""The backends: which there are, what they need, and which one "auto" means."""

from __future__ import annotations

import functools
import importlib
import warnings
from types import ModuleType
from typing import Any

import numpy as np

from ...arrays import ArrayOrTensor, to_numpy, to_tensor
from ...errors import InputError, InputWarning

BACKENDS = ("cpu", "torch", "numpy", "cuda")
"""Names of the backends. ``siddon_<name>`` is the module of each.

Such a module has four functions. Line integrals are ``L int_0^1 f(alpha) exp(-L int_0^alpha mu) dalpha`` with L the
ray's length in mm, f the volume and mu what attenuates, if anything.

- ``forward(volume, rays, attenuation=None)`` returns them, (N,).
- ``adjoint(volume, values, rays, attenuation=None)`` adds the values to the volume in place, each along its ray with
  the same weights.
- ``derivatives(volume, rays, attenuation=None)`` returns (N, 7): the integral over alpha (the line integral per mm of
  L), and its derivatives by the ray's start (3) and end (3) in index space. With attenuation (N, 14): the derivatives
  [1:7] are those through the planes of the volume, where f jumps, then follow [7:13] by start and end in mu's index
  space, through its planes, where mu jumps (also where mu shares the volume's lattice), all at constant L; and [13] by
  L, at constant ends.
- ``mu_gradient(gradient, volume, values, rays, attenuation)`` adds to `gradient` (of mu's shape) in place the sum over
  the rays of their values times the derivative of the line integral by mu.

`rays` are `IndexRays` or `IndexFans`, what weakens them an `Attenuation`; volumes, values, mu and gradients are tensors on
one device for "torch", numpy arrays or tensors on the GPU for "cuda" (see its `native`), and numpy arrays for the others.
"""

_AUTOMATIC = ("cpu", "torch", "numpy")
"""What "auto" chooses from, the one that it prefers first; for a tensor on a GPU see `for_tensor`."""

_OLD_NAMES = {"numba": "cpu"}
"""What files and scripts of version 0.1 call a backend."""

_PACKAGES = {"torch": "torch", "cuda": "warp-lang"}


def choose(name: str) -> str:
    """The backend that `name` ("auto", one of `BACKENDS` or an old name) stands for on this machine, loaded.

    Raises
    ------
    InputError
        No such backend, or the library or the GPU that it needs is missing.
    """
    name = _OLD_NAMES.get(name, name)
    if name != "auto" and name not in BACKENDS:
        raise InputError(f"backend {name!r}: expected one of auto, {', '.join(BACKENDS)}")
    if name != "auto":
        try:
            module = load(name)
        except _CANNOT_LOAD as error:
            remedy = f": pip install {_PACKAGES[name]}" if name in _PACKAGES else ""
            raise InputError(f"backend {name!r} cannot be used ({_reason(error)}){remedy}") from None
        if name == "cuda":
            module.device()
        return name
    for candidate in _AUTOMATIC:
        try:
            load(candidate)
        except _CANNOT_LOAD as error:
            if candidate == "cpu":
                reason = _reason(error)
            continue
        if candidate != "cpu":
            _warn_slower(candidate, reason)
        return candidate
    raise AssertionError("numpy is always there")


def for_tensor(tensor: Any) -> str:
    """What "auto" means for a tensor that is not on the CPU: "cuda" where that works, else "torch"."""
    return "cuda" if tensor.is_cuda and _cuda_works() else "torch"


@functools.cache
def _cuda_works() -> bool:
    try:
        load("cuda").device()
    except (InputError, *_CANNOT_LOAD):
        return False
    return True


def native(x: ArrayOrTensor, name: str, float64: bool) -> ArrayOrTensor:
    """`x` as the backend `name` computes with it; `float64` or float32 where it takes either."""
    if name == "cuda":
        return load(name).native(x)
    return to_tensor(x) if name == "torch" else to_numpy(x, np.float64 if float64 else np.float32)


def workers(name: str, threads: int) -> int:
    """On how many of `threads` a backend is to be called at the same time: torch and cuda have threads of their own."""
    return 1 if name in ("torch", "cuda") else threads


def load(name: str) -> ModuleType:
    """The module of a backend."""
    return importlib.import_module(f".siddon_{name}", __package__)


# A library may be absent, be none for this platform or fail to load its binaries.
_CANNOT_LOAD = (ImportError, OSError)


def _reason(error: BaseException) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


@functools.cache
def _warn_slower(name: str, reason: str) -> None:
    warnings.warn(
        f"projections run with {name}, many times slower than with the backend cpu ({reason})",
        InputWarning,
        stacklevel=4,
    )
