"""Checks of arguments where they enter the package."""

from collections.abc import Collection
from math import pi
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError, expecting, warn
from .memory import require

# Copies of fewer numbers always fit into memory.
_MANY = 2**20
_FEW = 2**12
"""Up to so many, a mask of which numbers are finite is faster than what does without."""

Shape = tuple[int | None, ...] | None
"""What an array's shape must be: None is any length, and None alone any shape."""


def real_array(value: ArrayLike, name: str, shape: Shape, dtype: Any = np.float64, batch: bool = False) -> NDArray[Any]:
    """A copy of `value` as a C-ordered array of real, finite numbers.

    In the expected `shape` None is any length; None alone is any shape; of a `batch`, any axes may come before it. Error
    messages say `name`, and the first index that is not finite, or too large for `dtype`.
    """
    raw = real_numbers(value, name)
    if raw.size > _MANY:
        require(raw.size * np.dtype(dtype).itemsize, f"{name} of {shape_text(raw.shape)} numbers")
    if raw.dtype == dtype:
        array = np.array(raw, order="C")
    else:
        with np.errstate(over="ignore"):  # what overflows is refused below
            array = np.array(raw, dtype=dtype, order="C")
    if shape is not None:
        shape = batch_shape(shape, array.shape) if batch else shape
        if array.ndim != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
            expected = " x ".join("any" if n is None else str(n) for n in shape) or "one number"
            raise InputError(f"{name}: expected shape {expected}, got {shape_text(array.shape)}")
    require_finite(array, name, raw)
    return array


def radians(value: ArrayLike, name: str, shape: Shape = ()) -> NDArray[np.float64]:
    """Angles in rad, checked by `real_array`; warns where they are, or reach over, more than a full turn, as degrees do."""
    angles = real_array(value, name, shape)
    most = max(float(np.ptp(angles)), float(np.abs(angles).min())) if angles.size else 0.0
    if most > 2.001 * pi:
        warn(f"{name}: {most:g} rad is more than a full turn: are these degrees? np.radians(...) converts them")
    return angles


def real_numbers(value: ArrayLike, name: str) -> NDArray[Any]:
    """`value` as an array of real numbers of its own type and order, not copied without need, or `InputError`.

    Masked numbers are refused: what stands under a mask would count, and it is not known what should instead.
    """
    if hidden := _masked(value):
        found = f"{hidden} of {np.size(value)} numbers are masked"  # type: ignore[arg-type]
        raise InputError(f"{name}: {found}; expected all of them: say what counts there, array.filled(...)")
    try:
        raw = np.asarray(value)
        if raw.dtype.kind not in "fiub":
            raise TypeError
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{name}: expected real numbers, got {type(value).__name__} {_short(value)}") from None
    except RuntimeError as error:  # a torch tensor that requires gradients; torch says what to do
        raise InputError(f"{name}: {error}") from None
    return raw


def _masked(value: Any) -> int:
    """How many numbers are masked, of an array, or of those in a list."""
    if isinstance(value, list | tuple):
        return sum(map(_masked, value))
    return int(value.mask.sum()) if isinstance(value, np.ma.MaskedArray) else 0


def batch_shape(shape: tuple[Any, ...], given: tuple[int, ...]) -> tuple[Any, ...]:
    """What `given` must be where any axes may come before those of `shape`."""
    return given[: max(0, len(given) - len(shape))] + shape


def require_finite(array: NDArray[Any], name: str, given: NDArray[Any] | None = None) -> None:
    """Raise `InputError` naming the first index at which `array` is not finite; it was made of the numbers `given`."""
    if array.size > _FEW:
        # A finite sum proves that all numbers are, in one pass without a mask. The sum of finite numbers may still
        # overflow.
        with np.errstate(over="ignore", invalid="ignore"):
            if np.isfinite(array.sum()):
                return
    finite = np.isfinite(array)
    if finite.all():
        return
    index = tuple(int(i) for i in np.argwhere(~finite)[0])
    where = f" at index {index if len(index) != 1 else index[0]}" if index else ""
    value = (array if given is None else given)[index]
    as_kept = f" in {array.dtype}" if np.isfinite(value) else ""
    raise InputError(f"{name}: {value} is not a finite number{as_kept}{where}")


def instance(value: object, kind: type, name: str) -> None:
    """Raise `InputError` unless `value` is a `kind`."""
    if not isinstance(value, kind):
        raise InputError(f"{name}: expected a {kind.__name__}, got {type(value).__name__}")


def one_of(value: object, known: Collection[object], name: str) -> None:
    """Raise `InputError` unless `value` is one of the `known` words."""
    if value not in known:
        raise InputError(f"{name} {value!r}: expected one of {', '.join(map(str, known))}")


def whole_shape(value: Any, name: str, length: int) -> Any:
    """`value` as a tuple of `length` whole numbers of at least 1, or `InputError`."""
    try:
        numbers = tuple(value)
        whole = tuple(int(n) for n in numbers)
        good = len(whole) == length and all(n == m and n >= 1 for n, m in zip(whole, numbers, strict=True))
    except (TypeError, ValueError, OverflowError):
        good = False
    if not good:
        raise InputError(f"{name}: expected {length} whole numbers of at least 1, got {_short(value)}")
    return whole


def whole_number(value: Any, name: str) -> int:
    """`value` as a whole number of at least 1, or `InputError`."""
    with expecting(f"{name}: expected a whole number of at least 1, got {_short(value)}", InputError):
        return int(whole_shape([value], name, 1)[0])


def strict_whole(value: Any, name: str, expected: str) -> int:
    """`value` as a whole number of at least 1, not of a type for fractions, or `InputError` with what is `expected`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise InputError(f"{name}: expected {expected}, got {value!r}")
    return int(value)


def seed_number(value: Any, name: str = "seed", also: str = "") -> int:
    """`value` as a whole number from 0 to 2^64 - 1, which every file can hold, or `InputError`; `also` may stand there."""
    is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_whole or not 0 <= value < 2**64:
        bound = "below 2^64" if is_whole and value > 0 else "of at least 0"
        raise InputError(f"{name}: expected {also}a whole number {bound}, got {_short(value)}")
    return int(value)


def all_above_0(value: Any, name: str, shape: Shape = None, unit: str = "") -> NDArray[np.float64]:
    """`value` as an array of finite numbers above 0, or `InputError`; `shape` as in `real_array`."""
    array = real_array(value, name, shape)
    if array.min(initial=np.inf) <= 0:
        raise InputError(f"{name}: expected more than 0{' ' + unit if unit else ''}, got {array.min():g}")
    return array


def none_below_0(value: Any, name: str, shape: Shape = None, unit: str = "") -> NDArray[np.float64]:
    """`value` as an array of finite numbers, each 0 or more, or `InputError`; `shape` as in `real_array`."""
    array = real_array(value, name, shape)
    if array.min(initial=0.0) < 0:
        raise InputError(f"{name}: expected 0 or more{' ' + unit if unit else ''}, got {array.min():g}")
    return array


def positive(value: Any, name: str, unit: str = "") -> float:
    """`value` as a finite number above 0, or `InputError`."""
    return float(all_above_0(value, name, (), unit))


def at_least_0(value: Any, name: str, unit: str = "") -> float:
    """`value` as a finite number, 0 or more, or `InputError`."""
    return float(none_below_0(value, name, (), unit))


def one_for_all(value: ArrayLike, name: str, n: int) -> NDArray[np.float64]:
    """`value` as `n` numbers, where one number stands for all, or `InputError`."""
    is_one = not isinstance(value, list | tuple) and np.ndim(value) == 0
    return real_array(np.broadcast_to(value, n) if is_one else value, name, (n,))


def lengths(value: ArrayLike, name: str, n: int, unit: str = "mm") -> NDArray[np.float64]:
    """`value` as `n` lengths above 0, where one number stands for all, or `InputError`."""
    return all_above_0(one_for_all(value, name, n), name, (n,), unit)


def freeze(array: NDArray[Any]) -> NDArray[Any]:
    """`array`, made read-only."""
    array.flags.writeable = False
    return array


def shape_text(shape: tuple[int, ...]) -> str:
    """A shape in messages: "3 x 4", or "one number"."""
    return " x ".join(map(str, shape)) or "one number"


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 40 else text[:37] + "..."
