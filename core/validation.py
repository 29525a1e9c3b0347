"""Checks of arguments where they enter the package."""

from collections.abc import Collection
from math import pi
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError, expecting, warn
from .memory import require

_MANY = 2**20
"""Number of elements up to which a copy of an array always fits into memory."""
_FEW = 2**12
"""Number of elements up to which a mask of the finite ones is faster than their sum."""

Shape = tuple[int | None, ...] | None
"""Expected shape of an array: a None in it accepts any length, None in its place any shape."""


def real_array(value: ArrayLike, name: str, shape: Shape, dtype: Any = np.float64, batch: bool = False) -> NDArray[Any]:
    """Return a copy of `value` as a C-ordered array of real, finite numbers of the expected `shape` (see `Shape`).

    With `batch`, any axes may precede those of `shape`. Raises `InputError`, whose message begins with `name` and gives the
    first index at which a number is not finite, or too large for `dtype`.
    """
    raw = real_numbers(value, name)
    if raw.size > _MANY:
        require(raw.size * np.dtype(dtype).itemsize, f"{name} of {shape_text(raw.shape)} numbers")
    if raw.dtype == dtype:
        array = np.array(raw, order="C")
    else:
        with np.errstate(over="ignore"):  # numbers that overflow are refused below
            array = np.array(raw, dtype=dtype, order="C")
    if shape is not None:
        shape = batch_shape(shape, array.shape) if batch else shape
        if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
            expected = " x ".join("any" if n is None else str(n) for n in shape) or "one number"
            raise InputError(f"{name}: expected shape {expected}, got {shape_text(array.shape)}")
    require_finite(array, name, raw)
    return array


def radians(value: ArrayLike, name: str, shape: Shape = ()) -> NDArray[np.float64]:
    """Return angles in rad as an array, checked by `real_array`.

    Warns if all angles, or their range, exceed a full turn, because they may be meant in degrees.
    """
    angles = real_array(value, name, shape)
    largest = max(float(np.ptp(angles)), float(np.abs(angles).min())) if angles.size else 0.0
    if largest > 2.001 * pi:
        warn(f"{name}: {largest:g} rad is more than a full turn: are these degrees? np.radians(...) converts them")
    return angles


def real_numbers(value: ArrayLike, name: str) -> NDArray[Any]:
    """Return `value` as an array of real numbers, with its own type and order, and not copied without need.

    Raises `InputError` if they are no real numbers, or if some are masked: the number under a mask would be used, and it is
    unknown which one should be used instead.
    """
    if n_masked := _count_masked(value):
        problem = f"{n_masked} of {np.size(value)} numbers are masked"  # type: ignore[arg-type]
        raise InputError(f"{name}: {problem}; expected none: give the number to use there, array.filled(...)")
    try:
        raw = np.asarray(value)
        if raw.dtype.kind not in "fiub":
            raise TypeError
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name}: expected real numbers, got {type(value).__name__} {_short(value)}") from None
    except RuntimeError as error:  # a torch tensor that requires gradients; torch's message says what to do
        raise InputError(f"{name}: {error}") from None
    return raw


def _count_masked(value: Any) -> int:
    """Return the number of masked elements of an array, or of all arrays in a list."""
    if isinstance(value, list | tuple):
        return sum(map(_count_masked, value))
    return int(value.mask.sum()) if isinstance(value, np.ma.MaskedArray) else 0


def batch_shape(shape: tuple[Any, ...], actual_shape: tuple[int, ...]) -> tuple[Any, ...]:
    """Return the expected shape of a batch: `shape`, preceded by the batch axes of `actual_shape`."""
    return actual_shape[: max(0, len(actual_shape) - len(shape))] + shape


def require_finite(array: NDArray[Any], name: str, original: NDArray[Any] | None = None) -> None:
    """Raise `InputError` that names the first index at which `array` is not finite.

    `original` holds the numbers of which `array` was made by a change of type; the message shows the number from there.
    """
    if array.size > _FEW:
        # A finite sum proves that all numbers are finite, in one pass without a mask. The sum of finite numbers may still
        # overflow.
        with np.errstate(over="ignore", invalid="ignore"):
            if np.isfinite(array.sum()):
                return
    finite = np.isfinite(array)
    if finite.all():
        return
    index = tuple(int(i) for i in np.argwhere(~finite)[0])
    where = f" at index {index if len(index) != 1 else index[0]}" if index else ""
    value = (array if original is None else original)[index]
    in_type = f" in {array.dtype}" if np.isfinite(value) else ""
    raise InputError(f"{name}: {value} is not a finite number{in_type}{where}")


def instance(value: object, kind: type, name: str) -> None:
    """Raise `InputError` unless `value` is an instance of the class `kind`."""
    if not isinstance(value, kind):
        raise InputError(f"{name}: expected a {kind.__name__}, got {type(value).__name__}")


def one_of(value: object, choices: Collection[object], name: str) -> None:
    """Raise `InputError` unless `value` is one of the `choices`."""
    if value not in tuple(choices):  # a list, say, cannot be looked up in a table
        raise InputError(f"{name} {value!r}: expected one of {', '.join(map(str, choices))}")


def whole_shape(value: Any, name: str, length: int) -> Any:
    """Return `value` as a tuple of `length` whole numbers of at least 1; raise `InputError` if it is none."""
    try:
        numbers = tuple(value)
        integers = tuple(int(n) for n in numbers)
        valid = len(integers) == length and all(n == m and n >= 1 for n, m in zip(integers, numbers, strict=True))
    except (TypeError, ValueError, OverflowError):
        valid = False
    if not valid:
        raise InputError(f"{name}: expected {length} whole numbers of at least 1, got {_short(value)}")
    return integers


def whole_number(value: Any, name: str) -> int:
    """Return `value` as a whole number of at least 1; raise `InputError` if it is none."""
    with expecting(f"{name}: expected a whole number of at least 1, got {_short(value)}", InputError):
        return int(whole_shape([value], name, 1)[0])


def strict_whole(value: Any, name: str, expected: str) -> int:
    """Return `value`, of an integer type, as a whole number of at least 1; raise `InputError`, which says `expected`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise InputError(f"{name}: expected {expected}, got {value!r}")
    return int(value)


def whole_in_file(value: Any, name: str, least: int = 0, largest: int | None = None) -> int:
    """Return a number of a file's header, or its text, as a whole number from `least` to `largest`.

    Raises `InputError` for others. Readers call it before a number drives a loop or takes memory; `largest` is what the
    bytes of the file allow.
    """
    try:
        number = float(value)
        is_valid = number == int(number) and least <= number and (largest is None or number <= largest)
    except (TypeError, ValueError, OverflowError):
        is_valid = False
    if not is_valid:
        limit = "" if largest is None else f" to {largest}"
        raise InputError(f"{name} = {value!s:.40}: expected a whole number from {least}{limit}")
    return int(number)


def seed_number(value: Any, name: str = "seed", also: str = "") -> int:
    """Return `value`, of an integer type, as a whole number from 0 to 2^64 - 1, which every file can hold.

    Raises `InputError`, whose message puts `also`, the other accepted values, before "a whole number".
    """
    is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_whole or not 0 <= value < 2**64:
        bound = "below 2^64" if is_whole and value > 0 else "of at least 0"
        raise InputError(f"{name}: expected {also}a whole number {bound}, got {_short(value)}")
    return int(value)


def all_above_0(value: Any, name: str, shape: Shape = None, unit: str = "") -> NDArray[np.float64]:
    """Return `value` as an array of finite numbers above 0 of the expected `shape`; raise `InputError` if it is none."""
    array = real_array(value, name, shape)
    if array.min(initial=np.inf) <= 0:
        raise InputError(f"{name}: expected more than 0{' ' + unit if unit else ''}, got {array.min():g}")
    return array


def none_below_0(value: Any, name: str, shape: Shape = None, unit: str = "") -> NDArray[np.float64]:
    """Return `value` as an array of finite numbers >= 0 of the expected `shape`; raise `InputError` if it is none."""
    array = real_array(value, name, shape)
    if array.min(initial=0.0) < 0:
        raise InputError(f"{name}: expected 0 or more{' ' + unit if unit else ''}, got {array.min():g}")
    return array


def positive(value: Any, name: str, unit: str = "") -> float:
    """Return `value` as a finite number above 0; raise `InputError` if it is none."""
    return float(all_above_0(value, name, (), unit))


def at_least_0(value: Any, name: str, unit: str = "") -> float:
    """Return `value` as a finite number >= 0; raise `InputError` if it is none."""
    return float(none_below_0(value, name, (), unit))


def one_for_all(value: ArrayLike, name: str, n: int) -> NDArray[np.float64]:
    """Return `value` as an array of `n` numbers, one number being repeated; raise `InputError` if it is neither."""
    is_number = not isinstance(value, list | tuple) and np.ndim(value) == 0
    return real_array(np.broadcast_to(value, n) if is_number else value, name, (n,))


def lengths(value: ArrayLike, name: str, n: int, unit: str = "mm") -> NDArray[np.float64]:
    """Return `value` as `n` lengths above 0, one number being repeated; raise `InputError` if it is neither."""
    return all_above_0(one_for_all(value, name, n), name, (n,), unit)


def freeze(array: NDArray[Any]) -> NDArray[Any]:
    """Make `array` read-only and return it."""
    array.flags.writeable = False
    return array


def shape_text(shape: tuple[int, ...]) -> str:
    """Return a shape as messages show it: "3 x 4", or "one number"."""
    return " x ".join(map(str, shape)) or "one number"


def _short(value: Any) -> str:
    """Return `value` as messages show it, in one line of at most 40 characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 40 else text[:37] + "..."
