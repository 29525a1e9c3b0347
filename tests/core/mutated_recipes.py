"""Mutations of recipes: what a slip, a damaged disk or malice makes of a TOML file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np

from mphdrr.core.recipes.toml import toml_value

KEY = "no_such_entry"
"""Key that no recipe knows."""


class Raw(str):
    """TOML as it stands."""


NUMBERS = (
    0, -1, 1, 2, 3, 7, -0.5, 0.5, 1e-300, 1e300, -1e300, 2**31, 2**63, 2**64, 10**18, -(10**18), 10**400, float("nan"),
    float("inf"), -float("inf"), 1.7976931348623157e308, 5e-324,
)  # fmt: skip
OTHERS = (
    True, False, "", "x", "a" * 3000, "../../..", "/dev/zero", "/", ".", "\x1b[31m\x07", "a\nb", "\u202e\u0000", "ä" * 40,
    [], [[]], [1, "a"], [[1, 2], [3]], [0] * 2000, {}, {"from": 1, "to": 2}, {"one_of": []}, {"a": {"b": {"c": 1}}}, [{}],
    Raw("1979-05-27T07:32:00Z"), Raw("07:32:00"), Raw("[" * 40 + "]" * 40), Raw("0x7fffffffffffffff"), Raw("1e999"),
    Raw("'''\na\n'''"),
)  # fmt: skip
"""Values of another kind than nearly every entry has."""
BYTES = b"\x00\x07\x1b\x7f\x85\xff\xfe\xe2\x80\xae\n\r\t\"'[]{}=,.#\\_-+ 019eEnN"


class Mutation(NamedTuple):
    """A recipe that was changed."""

    text: bytes
    """The file's bytes."""
    name: str
    """What was done."""
    has_unknown_key: bool = False
    """Whether it names `KEY`, which must be refused by this name."""


def as_toml(value: Any) -> str:
    """Return a value as TOML, tables within lines."""
    if isinstance(value, Raw):
        return value
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{toml_value(key)} = {as_toml(entry)}' for key, entry in value.items())} }}"
    return f"[{', '.join(map(as_toml, value))}]" if isinstance(value, list) else toml_value(value)


def document(values: dict[str, Any]) -> bytes:
    return "\n".join(f"{toml_value(key)} = {as_toml(value)}" for key, value in values.items()).encode()


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths of all entries below a value, those of lists, too."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, entry in items:
        yield (*path, key)
        yield from places(entry, (*path, key))


def at(values: Any, path: tuple[Any, ...]) -> Any:
    for step in path:
        values = values[step]
    return values


def tables(values: dict[str, Any]) -> list[tuple[Any, ...]]:
    return [path for path in ((), *places(values)) if isinstance(at(values, path), dict)]


def mutations(values: dict[str, Any], text: str, count: int, seed: int) -> Iterator[Mutation]:
    """Yield a recipe as it is, and `count` mutations of it, of its `values` or of the `text` of its file."""
    rng = np.random.default_rng(seed)

    def any_of(items: Any) -> Any:
        return items[int(rng.integers(len(items)))]

    def entry(other: Callable[[Any], Any], name: str) -> Mutation:
        changed = deepcopy(values)
        path = any_of(list(places(changed)))
        table, old = at(changed, path[:-1]), at(changed, path)
        table[path[-1]] = new = other(old)
        return Mutation(
            document(changed), f"{name}: {'.'.join(map(str, path))} = {as_toml(new)[:60]!r}, was {old!r:.60}"
        )

    def removed() -> Mutation:
        changed = deepcopy(values)
        path = any_of(list(places(changed)))
        del at(changed, path[:-1])[path[-1]]
        return Mutation(document(changed), f"removed: {'.'.join(map(str, path))}")

    def unknown() -> Mutation:
        changed = deepcopy(values)
        path = any_of(tables(changed))
        at(changed, path)[KEY] = any_of((3, "x", True, [1.5], {"a": 1}))
        return Mutation(document(changed), f"unknown key in {path}", True)

    def renamed() -> Mutation:
        changed = deepcopy(values)
        path = any_of([path for path in places(changed) if isinstance(path[-1], str)])
        table = at(changed, path[:-1])
        table[KEY] = table.pop(path[-1])
        return Mutation(document(changed), f"renamed: {path}", True)

    def swapped() -> Mutation:
        changed = deepcopy(values)
        one, other = (
            any_of([path for path in places(changed) if not isinstance(at(changed, path), dict)]) for _ in "ab"
        )
        a, b = at(changed, one), at(changed, other)
        if one[: len(other)] != other and other[: len(one)] != one:
            at(changed, one[:-1])[one[-1]], at(changed, other[:-1])[other[-1]] = b, a
        return Mutation(document(changed), f"swapped: {one}, {other}")

    def moved() -> Mutation:
        changed = deepcopy(values)
        path, target = any_of(list(places(changed))), any_of(tables(changed))
        value = at(changed, path)
        at(changed, target)[str(path[-1])] = deepcopy(value)
        return Mutation(document(changed), f"copied: {path} to {target}")

    lines = text.splitlines(keepends=True)

    def doubled() -> Mutation:
        n = int(rng.integers(len(lines)))
        m = n + int(rng.integers(1, 8))
        return Mutation("".join([*lines[:m], *lines[n:m], *lines[m:]]).encode(), f"lines {n} to {m} twice")

    def cut() -> Mutation:
        data = text.encode()
        return Mutation(data[: (n := int(rng.integers(len(data))))], f"cut after {n} bytes")

    def deep() -> Mutation:
        n, (a, b) = any_of((30, 300, 3000)), any_of(("[]", ("{a=", "}")))
        changed = deepcopy(values)
        path = any_of(list(places(changed)))
        at(changed, path[:-1])[path[-1]] = Raw(a * n + ("" if a == "[" else "1") + b * n)
        return Mutation(document(changed), f"{n} deep: {path}")

    def flipped() -> Mutation:
        data = bytearray(text.encode())
        for n in rng.integers(len(data), size=int(rng.integers(1, 4))):
            data[n] = any_of(BYTES) if rng.random() < 0.5 else data[n] ^ 1 << int(rng.integers(8))
        return Mutation(bytes(data), "bytes changed")

    ways = (
        lambda: entry(lambda _: any_of(NUMBERS), "number"),
        lambda: entry(lambda _: any_of(NUMBERS), "number"),
        lambda: entry(lambda _: any_of(OTHERS), "other kind"),
        lambda: entry(lambda _: any_of(OTHERS), "other kind"),
        lambda: entry(lambda old: [deepcopy(old)] * int(rng.integers(1, 5)), "list"),
        lambda: entry(lambda old: -old if isinstance(old, int | float) else str(old), "sign or text"),
        lambda: entry(lambda old: old * any_of((1000, 10**6)) if isinstance(old, int | float) else old, "larger"),
        removed, removed, unknown, renamed, swapped, moved, doubled, cut, deep, flipped, flipped,
    )  # fmt: skip
    yield Mutation(document(values), "nothing")
    for n in range(count):
        yield ways[n % len(ways)]()
