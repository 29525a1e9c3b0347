"""Numpy arrays and torch tensors: checked on the way in, of the caller's kind on the way out."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from ..checks import real_array, require_finite
from ..errors import InputError

ArrayOrTensor = Any  # a numpy array or a torch tensor; torch may not be installed


def is_tensor(value: object) -> bool:
    """Whether `value` is a torch tensor (torch is not imported to find out)."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def namespace(value: ArrayOrTensor) -> Any:
    """The library, torch or numpy, whose functions take `value`."""
    return sys.modules["torch"] if is_tensor(value) else np


def is_double(value: object) -> bool:
    """Whether `value` is a torch tensor of float64."""
    return is_tensor(value) and str(value.dtype) == "torch.float64"  # type: ignore[attr-defined]


def checked(value: ArrayOrTensor, name: str, shape: tuple[int, ...], float64: bool) -> ArrayOrTensor:
    """`value` as float32 or float64 numbers, still an array or still a tensor on its device; not copied without need.

    A float64 tensor stays float64.

    Raises
    ------
    InputError
        Not real numbers, another shape, or a value that is not finite (its index is named).
    """
    if is_tensor(value):
        return _checked_tensor(value, name, shape, float64)
    dtype = np.float64 if float64 else np.float32
    if isinstance(value, np.ndarray) and value.dtype == dtype and value.shape == shape and value.flags.c_contiguous:
        require_finite(value, name)
        return value
    with np.errstate(over="ignore"):  # what overflows float32 is refused as not finite
        return real_array(value, name, shape, dtype)


def _checked_tensor(value: Any, name: str, shape: tuple[int, ...], float64: bool) -> Any:
    import torch

    if value.is_complex() or value.is_sparse or value.is_quantized:
        raise InputError(f"{name}: expected a dense tensor of real numbers, got {value.dtype}, {value.layout}")
    if tuple(value.shape) != shape:
        raise InputError(f"{name}: expected shape {_times(shape)}, got {_times(value.shape)}")
    if value.dtype != torch.float64:
        value = value.to(torch.float64 if float64 else torch.float32)
    if not bool(torch.isfinite(value.detach().sum())):
        require_finite(value.detach().cpu().numpy(), name)
    return value


def to_numpy(value: ArrayOrTensor, dtype: Any) -> np.ndarray[Any, Any]:
    """As a C-ordered, aligned array (compiled kernels take no other)."""
    if is_tensor(value):
        value = value.numpy(force=True)
    return np.require(value, dtype, ["C", "A"])


def to_tensor(value: ArrayOrTensor) -> Any:
    """As a contiguous tensor: a tensor on its own device, an array on torch's default device."""
    import torch

    if is_tensor(value):
        return value.detach().contiguous()
    if not value.flags.writeable:
        value = value.copy()  # torch has no read-only tensors
    return torch.from_numpy(np.ascontiguousarray(value)).to(torch.get_default_device())


def like(result: ArrayOrTensor, given: ArrayOrTensor) -> ArrayOrTensor:
    """`result` of the kind of `given`: a tensor on its device, or a numpy array."""
    if is_tensor(given):
        import torch

        return torch.as_tensor(result, device=given.device)
    return result.cpu().numpy() if is_tensor(result) else result


def zeros(shape: tuple[int, ...], beside: ArrayOrTensor) -> ArrayOrTensor:
    """Zeros of the kind, type and device of `beside`."""
    return beside.new_zeros(shape) if is_tensor(beside) else np.zeros(shape, beside.dtype)


def alike(values: ArrayOrTensor, beside: ArrayOrTensor) -> ArrayOrTensor:
    """`values` of the kind, type and device of `beside`; not part of a graph."""
    if not is_tensor(beside):
        return to_numpy(values, beside.dtype) if is_tensor(values) else np.asarray(values, dtype=beside.dtype)
    if is_tensor(values):
        return values.detach().to(beside).contiguous()
    import torch

    return torch.tensor(values, dtype=beside.dtype, device=beside.device)


def together(first: ArrayOrTensor, second: ArrayOrTensor) -> tuple[ArrayOrTensor, ArrayOrTensor]:
    """Both as tensors of one type and device if either is a tensor, still part of their graphs; else as they are."""
    if not (is_tensor(first) or is_tensor(second)):
        return first, second
    import torch

    one, other = (x if is_tensor(x) else torch.tensor(x) for x in (first, second))
    kind = torch.promote_types(one.dtype, other.dtype)
    device = one.device if is_tensor(first) else other.device
    return one.to(device, kind), other.to(device, kind)


def cropped(*volumes: ArrayOrTensor) -> tuple[list[ArrayOrTensor], tuple[int, int, int]]:
    """The smallest box of `volumes` (of one shape) that holds all that is not 0, and the index of its first voxel."""
    filled = [volume != 0 for volume in volumes]
    # Whether a line along y, or along x, holds anything: fast, for along z neighbours in memory would be joined.
    along_x, along_y = ([flags.any(axis) for flags in filled] for axis in (0, 1))
    ranges: list[tuple[int, int]] = []
    for lines, across in ((along_y, 1), (along_x, 1), (along_x, 0)):
        holds = [flags.any(across) for flags in lines]
        where = np.concatenate([np.flatnonzero(flags.cpu().numpy() if is_tensor(flags) else flags) for flags in holds])
        ranges.append((int(where.min()), int(where.max()) + 1) if len(where) else (0, 1))
    boxes = [volume[tuple(slice(first, last) for first, last in ranges)] for volume in volumes]
    boxes = [box.contiguous() if is_tensor(box) else np.ascontiguousarray(box) for box in boxes]
    return boxes, (ranges[0][0], ranges[1][0], ranges[2][0])


def _times(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape)) or "one number"
