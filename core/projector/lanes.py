"""Sixteen rays at once: short vectors as numbers in numba.

A variable of one of these types has a value for each of `WIDTH` rays, its lanes; LLVM makes of it what the processor has
(two registers of AVX2, one of AVX-512, four of NEON). Compiled code then says in so many words what is done
side by side, and does not depend on what an optimiser finds out. Masks are lanes of true and false; `where` chooses.

Only what `siddon_numba` needs is here, all of it inlined.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

WIDTH = 16

_INT32, _INT64 = ir.IntType(32), ir.IntType(64)
_ELEMENTS = {"f32": ir.FloatType(), "f64": ir.DoubleType(), "i32": _INT32, "mask": ir.IntType(1)}
_NUMBERS = {"f32": types.float32, "f64": types.float64, "i32": types.int32}


class Lanes(types.Type):
    """`WIDTH` values of one kind: "f32", "f64", "i32" or "mask"."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.vector = ir.VectorType(_ELEMENTS[kind], WIDTH)
        super().__init__(f"Lanes({kind})")


F32, F64, I32, MASK = (Lanes(kind) for kind in _ELEMENTS)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, lanes: Lanes) -> None:
        super().__init__(manager, lanes, lanes.vector)


# Operators.


def _define(function: Any, kinds: tuple[str, ...], emit: Callable[..., Any], result: Lanes | None = None) -> None:
    """Make ``function(x, y)`` known for two lanes of one of `kinds`."""

    @infer_global(function)
    class _Typing(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            x, y = args if len(args) == 2 else (None, None)
            if isinstance(x, Lanes) and x == y and x.kind in kinds:
                return signature(result or x, x, y)
            return None

    for kind in kinds:

        @lower_builtin(function, Lanes(kind), Lanes(kind))
        def _lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return emit(builder, sig.args[0].kind, *args)


def _of_numbers(for_reals: str, for_whole: str) -> Callable[..., Any]:
    return lambda b, kind, x, y: getattr(b, for_whole if kind == "i32" else for_reals)(x, y)


def _comparison(sign: str) -> Callable[..., Any]:
    return lambda b, kind, x, y: b.icmp_signed(sign, x, y) if kind == "i32" else b.fcmp_ordered(sign, x, y)


_define(operator.add, ("f32", "f64", "i32"), _of_numbers("fadd", "add"))
_define(operator.sub, ("f32", "f64", "i32"), _of_numbers("fsub", "sub"))
_define(operator.mul, ("f32", "f64", "i32"), _of_numbers("fmul", "mul"))
_define(operator.truediv, ("f32", "f64"), lambda b, kind, x, y: b.fdiv(x, y))
_define(operator.lt, ("f32", "f64", "i32"), _comparison("<"), MASK)
_define(operator.le, ("f32", "f64", "i32"), _comparison("<="), MASK)
_define(operator.gt, ("f32", "f64", "i32"), _comparison(">"), MASK)
_define(operator.ge, ("f32", "f64", "i32"), _comparison(">="), MASK)
_define(operator.eq, ("f32", "f64", "i32"), _comparison("=="), MASK)
_define(operator.and_, ("mask",), lambda b, kind, x, y: b.and_(x, y))
_define(operator.or_, ("mask",), lambda b, kind, x, y: b.or_(x, y))


# Functions, lane by lane.


@intrinsic
def where(typing, mask, x, y):  # type: ignore[no-untyped-def]
    """`x` where `mask` is true, else `y`."""
    return x(mask, x, y), lambda context, b, sig, args: b.select(*args)


@intrinsic
def minimum(typing, x, y):  # type: ignore[no-untyped-def]
    """The smaller of two."""
    return x(x, y), lambda context, b, sig, args: b.select(b.fcmp_ordered("<", *args), *args)


@intrinsic
def maximum(typing, x, y):  # type: ignore[no-untyped-def]
    """The larger of two."""
    return x(x, y), lambda context, b, sig, args: b.select(b.fcmp_ordered(">", *args), *args)


def _of_llvm(name: str, arity: int) -> Callable[..., Any]:
    """LLVM's function of this name, lane by lane."""

    def emit(context: Any, b: Any, sig: Any, args: Any) -> Any:
        lanes = sig.return_type
        full = f"llvm.{name}.v{WIDTH}{lanes.kind}"
        return b.call(
            cgutils.get_or_insert_function(b.module, ir.FunctionType(lanes.vector, [lanes.vector] * arity), full), args
        )

    @intrinsic
    def one(typing, x):  # type: ignore[no-untyped-def]
        return x(x), emit

    @intrinsic
    def three(typing, x, y, z):  # type: ignore[no-untyped-def]
        return x(x, y, z), emit

    return one if arity == 1 else three


floor = _of_llvm("floor", 1)
rint = _of_llvm("rint", 1)
magnitude = _of_llvm("fabs", 1)
root = _of_llvm("sqrt", 1)
# x * y + z, rounded once or twice, as the processor does it faster.
multiply_add = _of_llvm("fmuladd", 3)


@intrinsic
def whole(typing, x):  # type: ignore[no-untyped-def]
    """`x` as i32, rounded towards 0."""
    return I32(x), lambda context, b, sig, args: b.fptosi(args[0], I32.vector)


@intrinsic
def alike(typing, x, example):  # type: ignore[no-untyped-def]
    """`x`, numbers of any kind in lanes or one number, as lanes of the kind of `example`, f32 or f64."""

    def emit(context: Any, b: Any, sig: Any, args: Any) -> Any:
        given, wanted = sig.args
        if not isinstance(given, Lanes):
            return _filled(b, wanted, context.cast(b, args[0], given, _NUMBERS[wanted.kind]))
        if given == wanted:
            return args[0]
        convert = {"i32": b.sitofp, "f32": b.fpext, "f64": b.fptrunc}[given.kind]
        return convert(args[0], wanted.vector)

    return example(x, example), emit


@intrinsic
def zeros_of(typing, array):  # type: ignore[no-untyped-def]
    """Zeros, f32 or f64 after the array's type."""
    lanes = _of(array)
    return lanes(array), lambda context, b, sig, args: ir.Constant(lanes.vector, [0.0] * WIDTH)


@intrinsic
def half_to_the(typing, n, example):  # type: ignore[no-untyped-def]
    """1/2 to the power of `n`, i32 from 0 to 120, as lanes of the kind of `example`."""

    def emit(context: Any, b: Any, sig: Any, args: Any) -> Any:
        if sig.return_type == F32:
            exponent, bias, shift = args[0], 127, 23
        else:
            exponent, bias, shift = b.sext(args[0], ir.VectorType(_INT64, WIDTH)), 1023, 52
        kind = exponent.type
        bits = b.shl(b.sub(ir.Constant(kind, [bias] * WIDTH), exponent), ir.Constant(kind, [shift] * WIDTH))
        return b.bitcast(bits, sig.return_type.vector)

    return example(n, example), emit


@intrinsic
def is_double(typing, x):  # type: ignore[no-untyped-def]
    """Whether lanes are f64: known when compiling."""
    return types.boolean(x), lambda context, b, sig, args: context.get_constant(types.boolean, x == F64)


def _filled(b: Any, lanes: Lanes, number: Any) -> Any:
    nothing = ir.Constant(lanes.vector, ir.Undefined)
    first = b.insert_element(nothing, number, _INT32(0))
    return b.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(_INT32, WIDTH), [0] * WIDTH))


def _everywhere(lanes: Lanes) -> Callable[..., Any]:
    """One number in all lanes."""

    @intrinsic
    def fill(typing, x):  # type: ignore[no-untyped-def]
        def emit(context: Any, b: Any, sig: Any, args: Any) -> Any:
            return _filled(b, lanes, context.cast(b, args[0], sig.args[0], _NUMBERS[lanes.kind]))

        return lanes(x), emit

    return fill


f64, i32 = _everywhere(F64), _everywhere(I32)


@intrinsic
def numbered(typing):  # type: ignore[no-untyped-def]
    """0, 1, 2 ... as f64."""
    return F64(), lambda context, b, sig, args: ir.Constant(F64.vector, [float(i) for i in range(WIDTH)])


@intrinsic
def largest(typing, x):  # type: ignore[no-untyped-def]
    """The largest of lanes of i32, a number."""

    def emit(context: Any, b: Any, sig: Any, args: Any) -> Any:
        most = b.extract_element(args[0], _INT32(0))
        for i in range(1, WIDTH):
            other = b.extract_element(args[0], _INT32(i))
            most = b.select(b.icmp_signed(">", other, most), other, most)
        return most

    return types.int32(x), emit


# Memory. Arrays are 1-D and contiguous; nothing checks an index.


def _of(array: Any) -> Lanes:
    return F64 if array.dtype == types.float64 else F32


def _data(context: Any, b: Any, array: Any, value: Any) -> Any:
    return context.make_array(array)(context, b, value).data


# Lanes whose later elements are sent for: neighbours share what comes at once (16 numbers of float32).
_FETCHED = range(0, WIDTH, 5)


def _addresses(context: Any, b: Any, array: Any, value: Any, place: Any, *, writes: bool) -> list[Any]:
    """Of ``array[index]``, a pointer for every lane; `place` is index and ahead, of `gather`."""
    index, ahead = cgutils.unpack_tuple(b, place)
    data = _data(context, b, array, value)
    later = b.gep(data, [b.sext(b.extract_element(ahead, _INT32(WIDTH // 2)), _INT64)])
    # Two indices at a time: each way out of a vector register costs.
    pairs = b.bitcast(index, ir.VectorType(_INT64, WIDTH // 2))
    indices = []
    for i in range(WIDTH // 2):
        pair = b.extract_element(pairs, _INT32(i))
        indices += [b.and_(pair, _INT64(0xFFFFFFFF)), b.lshr(pair, _INT64(32))]
    for i in _FETCHED:
        _fetch(b, b.gep(later, [indices[i]]), writes)
    return [b.gep(data, [i], inbounds=True) for i in indices]


def _fetch(b: Any, pointer: Any, writes: bool) -> None:
    """Send for what is there, to be in the processor's cache when it is needed; an address outside an array does no harm."""
    byte = ir.IntType(8).as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [byte, _INT32, _INT32, _INT32])
    fetch = cgutils.get_or_insert_function(b.module, kind, "llvm.prefetch.p0i8")
    # For writing or reading; to be kept as long as possible; of data, not code.
    b.call(fetch, [b.bitcast(pointer, byte), _INT32(int(writes)), _INT32(3), _INT32(1)])


@intrinsic
def gather(typing, array, place):  # type: ignore[no-untyped-def]
    """``array[index]``, f32 or f64 after the array's type.

    `place` is (index, ahead), both i32: no index is negative; index + ahead is where the rays will be some time later,
    and what is there is sent for (ahead is taken to be that of the middle ray for all).
    """
    lanes = _of(array)

    def emit(context: Any, b: Any, sig: Any, args: Any) -> Any:
        result = ir.Constant(lanes.vector, ir.Undefined)
        for i, pointer in enumerate(_addresses(context, b, sig.args[0], *args, writes=False)):
            result = b.insert_element(result, b.load(pointer), _INT32(i))
        return result

    return lanes(array, place), emit


@intrinsic
def scatter_add(typing, array, place, x):  # type: ignore[no-untyped-def]
    """``array[index] += x``, lane after lane: equal indices add up. `place` as of `gather`."""

    def emit(context: Any, b: Any, sig: Any, args: Any) -> Any:
        for i, pointer in enumerate(_addresses(context, b, sig.args[0], *args[:2], writes=True)):
            b.store(b.fadd(b.load(pointer), b.extract_element(args[2], _INT32(i))), pointer)
        return context.get_dummy_value()

    return types.void(array, place, x), emit


@intrinsic
def load(typing, array, first):  # type: ignore[no-untyped-def]
    """``array[first : first + WIDTH]`` as f32 or f64, after the array's type."""
    lanes = _of(array)

    def emit(context: Any, b: Any, sig: Any, args: Any) -> Any:
        place = b.gep(_data(context, b, sig.args[0], args[0]), [args[1]])
        vector = b.load(b.bitcast(place, lanes.vector.as_pointer()))
        vector.align = 4
        return vector

    return lanes(array, first), emit


@intrinsic
def store(typing, array, first, x):  # type: ignore[no-untyped-def]
    """``array[first : first + WIDTH] = x``."""

    def emit(context: Any, b: Any, sig: Any, args: Any) -> Any:
        place = b.gep(_data(context, b, sig.args[0], args[0]), [args[1]])
        b.store(args[2], b.bitcast(place, args[2].type.as_pointer())).align = 4
        return context.get_dummy_value()

    return types.void(array, first, x), emit


def _leaves(value: Any) -> list[Lanes]:
    """The lanes in nested tuples, in order."""
    return [value] if isinstance(value, Lanes) else [leaf for part in value for leaf in _leaves(part)]


def _words(lanes: Lanes) -> int:
    return 2 * WIDTH if lanes.kind == "f64" else WIDTH


@intrinsic
def words(typing, value):  # type: ignore[no-untyped-def]
    """Numbers of float32 that `put_aside` needs for `value`, nested tuples of lanes (no masks)."""
    total = sum(map(_words, _leaves(value)))
    return types.intp(value), lambda context, b, sig, args: context.get_constant(types.intp, total)


@intrinsic
def put_aside(typing, array, first, value):  # type: ignore[no-untyped-def]
    """`value`, nested tuples of lanes, into an array of float32 from `first` on."""

    def emit(context: Any, b: Any, sig: Any, args: Any) -> Any:
        place = b.gep(_data(context, b, sig.args[0], args[0]), [args[1]])

        def put(kind: Any, parts: Any) -> None:
            nonlocal place
            if isinstance(kind, Lanes):
                b.store(parts, b.bitcast(place, kind.vector.as_pointer())).align = 4
                place = b.gep(place, [_INT64(_words(kind))])
                return
            for inner, part in zip(kind, cgutils.unpack_tuple(b, parts), strict=True):
                put(inner, part)

        put(value, args[2])
        return context.get_dummy_value()

    return types.void(array, first, value), emit


@intrinsic
def take_back(typing, array, first, like):  # type: ignore[no-untyped-def]
    """What `put_aside` has put there, of the type of `like`."""

    def emit(context: Any, b: Any, sig: Any, args: Any) -> Any:
        place = b.gep(_data(context, b, sig.args[0], args[0]), [args[1]])

        def take(kind: Any) -> Any:
            nonlocal place
            if isinstance(kind, Lanes):
                vector = b.load(b.bitcast(place, kind.vector.as_pointer()))
                vector.align = 4
                place = b.gep(place, [_INT64(_words(kind))])
                return vector
            return context.make_tuple(b, kind, [take(inner) for inner in kind])

        return take(like)

    return like(array, first, like), emit
