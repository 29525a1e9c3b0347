"""NumPy arrays and torch tensors: checks of arguments, and conversion of results to the caller's kind."""

import functools
import sys
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike as ArrayLike
from numpy.typing import NDArray

from .errors import InputError
from .validation import batch_shape, real_array, real_numbers, require_finite, shape_text

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Bools = NDArray[np.bool_]
Indexes = NDArray[np.intp]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Array = NDArray[Any]  # an array of any type
P = ParamSpec("P")
R = TypeVar("R")
ArrayOrTensor = Any  # a numpy array or a torch tensor; torch may not be installed


def is_tensor(value: object) -> bool:
    """Return whether `value` is a torch tensor, without importing torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def namespace(*values: ArrayOrTensor) -> Any:
    """Return the module whose functions take `values`: torch if any of them is a tensor, else numpy."""
    return sys.modules["torch"] if any(map(is_tensor, values)) else np


def is_double(value: object) -> bool:
    """Return whether `value` is a torch tensor of float64."""
    return is_tensor(value) and str(value.dtype) == "torch.float64"  # type: ignore[attr-defined]


def is_transformed(value: object) -> bool:
    """Return whether `value` is a tensor that torch.func (vmap, grad, jvp ...) transforms: its numbers cannot be read."""
    return is_tensor(value) and sys.modules["torch"]._C._are_functorch_transforms_active()


def uncompiled(function: Callable[P, R]) -> Callable[P, R]:
    """Return `function` with a break of the graph around it in torch.compile, which does not compile it."""

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        torch: Any = sys.modules.get("torch")
        is_compiling = torch is not None and torch.compiler.is_compiling()
        return (torch.compiler.disable(function) if is_compiling else function)(*args, **kwargs)

    return call


def checked(
    value: ArrayOrTensor, name: str, shape: tuple[int, ...], float64: bool, batch: bool = False, finite: bool = False
) -> ArrayOrTensor:
    """Return `value` as real numbers of the expected `shape`, float64 if `float64` is true, else float32.

    An array stays an array and a tensor stays a tensor on its device; neither is copied without need. A float64 tensor stays
    float64. With `batch`, any axes may precede those of `shape`. With `finite`, a tensor is not checked for infinities and
    NaN, because the caller has done so. Raises `InputError`, whose message begins with `name`.
    """
    if is_tensor(value):
        import torch

        require_numbers(value, name)
        expected = batch_shape(shape, tuple(value.shape)) if batch else shape
        if tuple(value.shape) != expected:
            raise InputError(f"{name}: expected shape {shape_text(expected)}, got {shape_text(value.shape)}")
        if value.dtype != torch.float64:
            value = value.to(torch.float64 if float64 else torch.float32)
        if not finite and not bool(torch.isfinite(value.detach().sum())):
            require_finite(value.detach().cpu().numpy(), name)
        return value
    dtype = np.float64 if float64 else np.float32
    value = real_numbers(value, name)
    expected = batch_shape(shape, value.shape) if batch else shape
    if value.dtype == dtype and value.flags.c_contiguous and value.shape == expected:
        require_finite(value, name)
        return value
    return real_array(value, name, shape, dtype, batch)


def require_numbers(tensor: Any, name: str) -> None:
    """Raise `InputError` unless `tensor` is a dense tensor of real numbers that is in memory."""
    if is_transformed(tensor):
        advice = "which works with the volume of a projector alone: take autograd, or a loop"
        raise InputError(f"{name}: expected a tensor outside torch.func, {advice}")
    if tensor.is_complex() or tensor.is_quantized or tensor.is_meta or str(tensor.layout) != "torch.strided":
        kind = f"{tensor.dtype}, {tensor.layout}, on {tensor.device}"
        raise InputError(f"{name}: expected a dense tensor of real numbers, got {kind}")


def to_numpy(value: ArrayOrTensor, dtype: Any) -> np.ndarray[Any, Any]:
    """Return `value` as a C-ordered, aligned array of `dtype`, as compiled kernels need it."""
    if is_tensor(value):
        value = value.numpy(force=True)
    return np.require(value, dtype, ["C", "A"])


def to_tensor(value: ArrayOrTensor) -> Any:
    """Return `value` as a contiguous tensor: a tensor stays on its device, an array goes to torch's default device."""
    import torch

    if is_tensor(value):
        return value.detach().contiguous()
    if not value.flags.writeable:
        value = value.copy()  # torch has no read-only tensors
    return torch.from_numpy(np.ascontiguousarray(value)).to(torch.get_default_device())


def to_caller(result: ArrayOrTensor, argument: ArrayOrTensor) -> ArrayOrTensor:
    """Return `result` as the kind of the caller's `argument`: a tensor on the argument's device, or a NumPy array."""
    if is_tensor(argument):
        import torch

        return torch.as_tensor(result, device=argument.device)
    return result.cpu().numpy() if is_tensor(result) else result


def zeros(shape: tuple[int, ...], like: ArrayOrTensor) -> ArrayOrTensor:
    """Return zeros of `shape`, an array or tensor of the type and on the device of `like`."""
    if is_tensor(like):
        return like.new_zeros(shape)
    # Unlike np.zeros, np.empty gets large pages of memory: a backprojection takes half the time.
    array = np.empty(shape, like.dtype)
    array.fill(0)
    return array


def cast_like(values: ArrayOrTensor, like: ArrayOrTensor) -> ArrayOrTensor:
    """Return `values` as an array or tensor of the type and on the device of `like`, detached from torch's graph."""
    if not is_tensor(like):
        return to_numpy(values, like.dtype) if is_tensor(values) else np.asarray(values, dtype=like.dtype)
    if is_tensor(values):
        return values.detach().to(like).contiguous()
    import torch

    return torch.tensor(values, dtype=like.dtype, device=like.device)


def promote(*values: ArrayOrTensor) -> tuple[ArrayOrTensor, ...]:
    """Return `values` as tensors of one type on one device if any of them is a tensor, else unchanged.

    Tensors stay part of torch's graph.
    """
    if (device := next((value.device for value in values if is_tensor(value)), None)) is None:
        return values
    import torch

    tensors = [value if is_tensor(value) else torch.tensor(value) for value in values]
    dtype = functools.reduce(torch.promote_types, (tensor.dtype for tensor in tensors))
    return tuple(tensor.to(device, dtype) for tensor in tensors)


def cropped(*volumes: ArrayOrTensor) -> tuple[list[ArrayOrTensor], tuple[int, int, int]]:
    """Crop `volumes`, all of one shape, to their common bounding box; return the cropped volumes and the box's first index.

    The bounding box is the smallest box that holds all nonzero voxels of all volumes; of zeros alone it is one voxel.
    """
    find_ranges = _filled_ranges_of_tensors if is_tensor(volumes[0]) else _filled_ranges
    ranges = find_ranges(volumes)
    boxes = [volume[tuple(slice(first, last) for first, last in ranges)] for volume in volumes]
    boxes = [box.contiguous() if is_tensor(box) else np.ascontiguousarray(box) for box in boxes]
    return boxes, (ranges[0][0], ranges[1][0], ranges[2][0])


def _filled_ranges(volumes: tuple[Array, ...]) -> list[tuple[int, int]]:
    """Return the range (first, last + 1) of the nonzero voxels' indices along each axis; reads the empty margins alone."""
    ranges: list[tuple[int, int]] = []
    for axis in (0, 1):
        slabs = [np.moveaxis(volume, axis, 0) for volume in volumes]
        indices = range(len(slabs[0]))
        if (first := next((i for i in indices if any(slab[i].any() for slab in slabs)), None)) is None:
            return [(0, 1)] * 3
        last = next(i for i in reversed(indices) if any(slab[i].any() for slab in slabs))
        ranges.append((first, last + 1))
        volumes = tuple(np.moveaxis(slab[first : last + 1], 0, axis) for slab in slabs)
    n = volumes[0].shape[2]
    if not all(any(volume[..., i].any() for volume in volumes) for i in (0, n - 1)):
        filled = np.flatnonzero(np.any([(volume != 0).any(axis=0).any(axis=0) for volume in volumes], axis=0))
        return [*ranges, (int(filled[0]), int(filled[-1]) + 1)]
    return [*ranges, (0, n)]


def _filled_ranges_of_tensors(volumes: tuple[Any, ...]) -> list[tuple[int, int]]:
    """Return `_filled_ranges` of tensors, in few steps because each one waits for the GPU."""
    filled = [volume != 0 for volume in volumes]
    # Rows along x and y are joined first: neighbours in memory, which lie along z, would be joined slowly.
    along_x, along_y = ([flags.any(axis) for flags in filled] for axis in (0, 1))
    ranges: list[tuple[int, int]] = []
    for rows, axis in ((along_y, 1), (along_x, 1), (along_x, 0)):
        indices = np.concatenate([np.flatnonzero(flags.any(axis).cpu().numpy()) for flags in rows])
        ranges.append((int(indices.min()), int(indices.max()) + 1) if len(indices) else (0, 1))
    return ranges


def table_rows(columns: dict[str, Array]) -> list[dict[str, Any]]:
    """Return the rows of a table that is given by its columns; the values are Python's own numbers and texts."""
    values = (column.tolist() for column in columns.values())
    return [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)]
