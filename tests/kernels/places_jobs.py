"""Hostile jobs of gather and scatter, and what the reference in numpy makes of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from mphdrr.core.perspective.places import LEAST, PRODUCT, SUM, _gather_in_numpy, _scatter_in_numpy, _stencils
from mphdrr.core.rays.backends.cpu import PlacesJob

from .jobs import BAD, Array, Made, Read, close, packed

JOBS = 1_000


def places_jobs() -> Iterator[Made]:
    rng = np.random.default_rng(21)
    with np.errstate(all="ignore"):
        for i in range(JOBS):
            yield _job(rng, i)


def _matrix(rng: np.random.Generator, kind: str, n: Array, m: Array, middle: float) -> Array:
    """Return rows (5, 4) that put many of the points (n) into an array (m)."""
    if kind == "border":  # all is exact: places on elements, between them, and on the borders
        whole = rng.integers(-2, 3, (5, 4)) * 0.5
        whole[3:] = [0, 0, 0, rng.choice([0.5, 1.0, 4.0])]
        whole[:3, 3] = (
            rng.choice([-0.5, 0.0, 1.0], 3) + rng.integers(0, 2, 3) * (m - 0.5) - whole[:3, 2] * round(middle)
        )
        whole[:3] *= whole[3, 3]
        return whole
    change = rng.uniform(-1.2, 1.2, (5, 3)) / n
    change[:3] *= m[:, None]
    change[3:] *= 3.0 if kind == "behind" else 0.3
    matrix = np.c_[change, -change @ [n[0] / 2, n[1] / 2, middle]]
    matrix[3:, 3] += 1
    if rng.random() < 0.5:
        matrix[4] = matrix[3]
    matrix[:3] += (m[:, None] - 1) / 2 * matrix[[3, 3, 4]]
    matrix[[0, 1, 3]] *= 10.0 ** rng.uniform(-3, 3)
    if kind == "behind" and rng.random() < 0.3:
        matrix[3] = np.round(matrix[3])  # p3 is 0 at some points, or at all
    if kind == "wild":
        matrix[tuple(rng.integers(0, (5, 4), (rng.integers(1, 4), 2)).T)] = rng.choice(BAD)
    return matrix


def _rounding(job: dict[str, Any], planes: Array, relative: Array, matrix: Array) -> tuple[Array, Array, Array]:
    """Return which points' numbers are within rounding of a border or out of range, and the allowed errors of values.

    A value's share is of the largest number of the array, divided by p3^2 where the job says so. A point is compared where
    it surely is in the array, or surely is not; all places that are computed exactly are.
    """
    kind, n, m, flat, nearest = (job[name] for name in ("kind", "n", "m", "flat", "nearest"))
    e, double = np.finfo(kind).eps, np.finfo(float).eps
    i, j = np.ogrid[: n[0], : n[1]]
    at = [np.abs(row[0] * i + row[1] * j + row[2] * job["middle"] + row[3])[..., None] for row in matrix]
    size = [a + np.abs(row[2] * relative) for a, row in zip(at, matrix, strict=True)]
    terms = [(np.abs(r[0]) * i + np.abs(r[1]) * j)[..., None] + np.abs(r[2]) * np.abs(planes) for r in matrix]
    full = [t + np.abs(r[2] * job["middle"]) + np.abs(r[3]) for t, r in zip(terms, matrix, strict=True)]
    p = [row[0] * i[..., None] + row[1] * j[..., None] + row[2] * planes + row[3] for row in matrix]
    exact = job["exact"]
    off = [0 * f if exact else 4 * (e * s + double * f) for s, f in zip(size, full, strict=True)]
    used = (0, 1, 3) if flat else (0, 1, 2, 3, 4)
    most = 1e15 if kind == np.float32 else 1e150
    out, sure, share = np.zeros(p[0].shape, bool), np.ones(p[0].shape, bool), np.zeros(p[0].shape)
    for row, least in ((3, nearest), (4, 0.0)):
        if row in used:
            out |= p[row] < least - off[row] if not exact else p[row] <= least
            sure &= (p[row] > least + 4 * off[row]) & (p[row] > 8 * off[row]) & (p[row] > 1 / most)
    for axis, divisor in ((0, 3), (1, 3), (2, 4)):
        if axis in used:
            place = p[axis] / p[divisor]
            by = (off[axis] + np.abs(place) * off[divisor]) / np.abs(p[divisor]) + (not exact) * 8 * e * np.abs(place)
            in_front = sure & (p[divisor] > 0)
            out |= in_front & ((place < -0.5 - by) | (place > m[axis] - 0.5 + by))
            sure &= (place >= -0.5 + by) & (place <= m[axis] - 0.5 - by)
            share = share + 2 * by
    share = share + 32 * e + (4 * off[3] / np.abs(p[3]) if job["by_depth"] else 0)
    in_range = np.all([f < most for a, f in enumerate(full) if a in used], axis=0)
    nowhere = bool(np.isnan(matrix[list(used)]).any())  # then no point is anywhere
    compared = (in_range & (out | sure)) | nowhere
    return ~compared, np.where(sure & compared & (not nowhere), share, 0.0), p[3]


def _job(rng: np.random.Generator, number: int) -> Made:
    kind, gives = (np.float32, np.float64)[number % 2], number // 2 % 3 == 0
    what = str(rng.choice(["ordinary", "border", "behind", "wild"]))
    flat, by_depth = bool(rng.random() < 0.3), bool(rng.random() < 0.3)
    how = SUM if gives else int(rng.choice([SUM, LEAST, PRODUCT]))
    n = np.array([*rng.integers(1, 4, 2), rng.integers(1, rng.choice([2, 9, 40]), endpoint=True)])
    m = rng.integers(1, rng.choice([2, 4, 12]), 3, endpoint=True)
    m[2] = 1 if flat else m[2]
    arrays = 1 if gives else int(rng.choice([1, 2, 11], p=[0.6, 0.3, 0.1]))
    third = rng.choice([0.5, 1.0]) * np.arange(n[2]) if what == "border" else np.sort(rng.uniform(0, n[2], n[2]))
    third = (third + rng.integers(-50, 50))[:: rng.choice([-1, 1])]
    middle = float(third[n[2] // 2])
    relative = (third - middle).astype(kind)
    planes = relative.astype(float) + middle
    matrices = np.stack([_matrix(rng, what, n, m, middle) for _ in range(arrays)])
    nearest = float(np.median(np.abs(matrices[:, 3, 3]))) if rng.random() < 0.1 else 0.0
    nearest = nearest if np.isfinite(nearest) and what != "wild" else 0.0
    scale = 10.0 ** rng.uniform(-15, 15) if how == PRODUCT else 1.0
    points = (rng.random(n) * (rng.random(n) < 0.8)).astype(kind)
    values = (rng.random((arrays, *m)) * (rng.random((arrays, *m)) < 0.9) * scale).astype(kind)
    first, last = np.sort(rng.integers(0, (m if gives else n)[0], 2, endpoint=True))
    if rng.random() < 0.5:
        first, last = 0, (m if gives else n)[0]
    seen, exponents = bool(rng.random() < 0.5), how == PRODUCT
    job: dict[str, Any] = {
        "kind": kind, "n": n, "m": m, "flat": flat, "by_depth": by_depth, "middle": middle, "nearest": nearest,
        "exact": what == "border",
    }  # fmt: skip
    others = {"flat": flat, "by_depth": by_depth, "nearest": nearest}
    rounding = [_rounding(job, planes, relative, matrix) for matrix in matrices]
    doubtful = np.any([each[0] for each in rounding], axis=0)
    not_finite = rng.random() < 0.1  # numbers: only that memory is left alone is looked at
    if not_finite:
        for numbers in (points, values):
            numbers[rng.random(numbers.shape) < 0.3] = rng.choice([np.nan, np.inf])
    elif gives and rng.random() < 0.7:
        points[doubtful] = 0
    struct = PlacesJob(
        is_double=kind == np.float64, how=how, flat=flat, by_depth=by_depth, n=tuple(n.tolist()), first=int(first),
        last=int(last), middle=middle, nearest=nearest, arrays=arrays, m=tuple(m.tolist()), seen=seen or None,
        exponents=exponents or None,
    )  # fmt: skip
    data = packed("give" if gives else "take", number // 6, struct, points, relative, values, matrices)
    right_points, right_values = points.astype(float), values.astype(float)
    off_points, off_values = np.zeros(n), 0.0
    counts, powers = np.zeros(n, np.int32), np.zeros(n, np.int32)
    part = slice(int(first), int(last))
    if gives and not not_finite:
        _, share, _ = rounding[0]
        matrix = matrices[0].copy()
        if flat:
            matrix[2], matrix[4] = 0, [0, 0, 0, 1]
        inside, _, _, depth = _stencils((n[0], n[1]), planes, matrix, tuple(m), flat, nearest)
        given = np.where(inside, right_points / (depth**2 if by_depth else 1), 0)
        _scatter_in_numpy(given, planes, right_values[0], matrix, part)
        sums = np.abs(given).sum() + np.nanmax(np.abs(right_values))
        off_values = float(np.sum(np.abs(given) * share * ~doubtful) + 8 * np.finfo(kind).eps * sums)
        if (doubtful & (points != 0)).any():
            right_values[:] = np.nan
    elif not not_finite:
        shifted = matrices.copy()
        shifted[..., 3] += first * shifted[..., 0]
        for array, matrix, (_, share, p3) in zip(right_values, shifted, rounding, strict=True):
            old, before = right_points[part].copy(), powers[part].copy()
            taken = (right_points[part], planes, array[None], matrix[None], how, counts[part], powers[part])
            _gather_in_numpy(*taken, **others)
            weight = 1 / p3[part] ** 2 if by_depth else 1.0
            off = np.where(share[part] > 0, share[part] * weight * array.max(), 0.0)
            e, new, more = np.finfo(kind).eps, right_points[part], powers[part] - before
            if how == PRODUCT:
                value = np.where((share[part] > 0) & (old > 0), np.ldexp(new, more) / old, 1.0)
                error = off_points[part] * (value + off) + old * off + 4 * e * old * value + np.finfo(kind).tiny
                off_points[part] = np.where(share[part] > 0, np.ldexp(error, -more), off_points[part])
            else:
                off_points[part] += off + e * np.abs(new)
    shown = ~doubtful
    if not gives:  # other parts' points stay as they are
        shown[: part.start] = shown[part.stop :] = True
    tiny = np.finfo(kind).tiny

    def check(read: Read) -> None:
        given, array = read(kind, tuple(n)), read(kind, (arrays, *m))
        given_counts = read(np.int32, tuple(n)) if seen else counts
        given_powers = read(np.int32, tuple(n)) if exponents else powers
        if gives:
            assert given.tobytes() == points.tobytes()
            if not not_finite:
                close("values", array, right_values, off_values + tiny)
            others_planes = np.delete(array[0], np.arange(first, last), axis=0)
            assert others_planes.tobytes() == np.delete(values[0], np.arange(first, last), axis=0).tobytes()
            return
        assert array.tobytes() == values.tobytes()
        if not_finite:
            return
        with np.errstate(all="ignore"):
            scaled = np.ldexp(given.astype(float), given_powers - powers)
        close("points", scaled, np.where(shown, right_points, np.nan), off_points + tiny)
        if seen:
            close("seen", given_counts.astype(float), np.where(shown, counts, np.nan), 0.0)

    return Made(data, check)
