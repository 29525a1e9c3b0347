"""What any scanner offers: a table of typed columns with a row for each module, its views, its solids, its source file.

`PinholeSystem` is the first kind. A new kind is a class derived from `Scanner` with its columns, and a line in
`core/scanner_kinds.py`.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields
from functools import lru_cache
from inspect import signature
from typing import Any, ClassVar, Literal, Self

import numpy as np

from ..arrays import Array, ArrayLike, Bools, Floats, Indexes, Integers
from ..errors import InputError
from ..system_source import SystemSource
from ..validation import freeze, real_array
from .columns import ColumnTable, Values
from .finding import Finding
from .module_parts import ModulePart
from .views import Views

Detector = Literal["virtual", "real"]

Fault = tuple[str, int, str]

SCANNERS: dict[str, type[Scanner]] = {}
"""Name -> class, of the kinds of scanners; each enters itself when it is defined."""

_signature = lru_cache(signature)  # which takes long


class Scanner(ABC):
    """M modules of one kind; a subclass is a frozen dataclass of what its table's columns hold.

    Its fields are attributes that columns name (`Column.field`), and ``numbers``, ``source`` and ``more``: `numbers` (M,)
    are the modules' own, by default 1, 2, ...; `source` is the workbook that it was read from; `more` has the values of
    columns of the table that are no field of the class, by their attribute's name, and is read as an attribute, too.
    """

    kind: ClassVar[str]
    """Its name in run files and in the scene: "pinhole"."""
    sheet: ClassVar[str] = ""
    """The one sheet of a workbook that holds it; "": those whose headings say so."""
    word: ClassVar[str] = "Module"
    """What its modules are called in the scene: "Module 07"."""
    takes: ClassVar[tuple[str, ...]] = ("activity", "mu")
    """What of a body its images can be of: quantities of volumes."""
    columns: ClassVar[ColumnTable]
    numbers: Integers
    source: SystemSource | None
    more: Mapping[str, Any]

    def __init_subclass__(cls, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        if "kind" in vars(cls):
            SCANNERS[cls.kind] = cls

    def __post_init__(self) -> None:
        own, more = vars(self), dict[str, Any]()
        given = own.keys() | self.more.keys()
        n: int | None = None
        if unknown := self.more.keys() - self.columns.fields.keys():
            raise InputError(f"{sorted(unknown)[0]}: is no column of a {self.kind} scanner")
        for name, columns in self.columns.fields.items():
            of = columns[0]
            values = getattr(self, name) if name in given else of.default(self.columns.needed_values(self))
            held = own if name in own else more
            held[name] = freeze(of.checked(values, n))
            n = len(held[name])
            if n == 0:
                raise InputError(f"a {self.kind} system needs at least one module, got none")
        wanted = np.arange(1, (n or 0) + 1) if self.numbers is None else self.numbers
        numbers = freeze(real_array(wanted, "numbers", (n,), np.int64))
        if not np.array_equal(numbers, wanted):
            raise InputError("numbers: expected whole numbers")
        own.update(more=more, numbers=numbers)
        for name, column in self.columns.scalars.items():
            if column.plausible[0] > 0:
                unit = next(iter(column.units))
                self._refuse(getattr(self, name) <= 0, f"{name} must be more than 0 {unit}, got {{{name}:g}}")
        self._refuse(repeated(numbers[:, None]), "another module has the same number")

    def __getattr__(self, name: str) -> Any:
        if name != "more" and name in self.more:
            return self.more[name]
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, which: int | slice | Array) -> Self:
        """The modules `which` (an index from 0, a slice, or an array of indices or booleans) as a scanner."""
        index = np.atleast_1d(np.arange(len(self))[which])
        if len(index) == 0:
            raise InputError(f"no module chosen: there are {len(self)}")
        changes = {name: getattr(self, name)[index] for name in self.columns.fields}
        return self.replace(**changes, numbers=self.numbers[index])

    def replace(self, **changes: Any) -> Self:
        """The same with other values of these attributes, those of `more` among them."""
        own = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        return self.of({**own.pop("more"), **own, **changes})

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """The scanner with these attributes, of which some may be columns without a field of the class."""
        own = _signature(cls).parameters
        more = {name: value for name, value in values.items() if name not in own}
        return cls(**{name: value for name, value in values.items() if name in own}, more=more)  # type: ignore[call-arg]

    @classmethod
    def from_values(cls, values: Values, numbers: ArrayLike | None = None, source: SystemSource | None = None) -> Self:
        """The scanner whose typed columns hold `values` (M,), mm, rad or texts; blank ones may be left out."""
        given: dict[str, Any] = {"numbers": numbers, "source": source}
        for name, columns in cls.columns.fields.items():
            own = {column.name: values[column.name] for column in columns if column.name in values}
            if own and columns[0].axis is None:
                given[name] = own[columns[0].name]
            elif own:
                absent = np.zeros(len(next(iter(own.values()))))
                given[name] = np.stack([own.get(column.name, absent) for column in columns], axis=1)
        return cls.of(given)

    def values(self) -> dict[str, Array]:
        """The values (M,) of the typed columns by name, mm, rad or texts."""
        return {name: self.columns[name].of(self) for name in self.columns.typed}

    def filled(self) -> dict[str, Array]:
        """The attributes that columns hold, without those in which all cells of a workbook could be blank."""
        typed = [self.columns[name] for name in self.columns.typed]
        used = {column.field for column in typed if not column.is_unused(self)}
        return {name: getattr(self, name) for name in self.columns.fields if name in used}

    @classmethod
    def faults(cls, values: Values, numbers: Sequence[int], place: Callable[[str, int], str]) -> Iterator[Fault]:
        """What no scanner of this kind has, of positive `values` of the needed columns of modules with these `numbers`.

        `place` gives the cell of a column and a module's index, for messages. Each fault is the column whose cell is at
        fault, the first module for which it is, and why it is, after the cell.
        """
        yield from ()

    def _refuse(self, bad: Bools, message: str) -> None:
        """Refuse the first module that is `bad`; `message` is a template of its attributes."""
        for i in first(bad):
            own = {name: np.ravel(getattr(self, name))[i] for name in re.findall(r"{(\w+)", message)}
            raise InputError(f"module {self.numbers[i]}: {message.format(**own)}")

    @abstractmethod
    def poses(self) -> Floats:
        """World-from-module poses (M, 4, 4): columns u, v, k, at right angles to its image, and the source's place, mm."""

    def frames(self) -> Floats:
        """Module frames (M, 3, 3), rows u, v, k."""
        return self.poses()[:, :3, :3].transpose(0, 2, 1)

    @abstractmethod
    def attributes_at(self, poses: Floats) -> Mapping[str, Array]:
        """The attributes that its modules have when they are moved and turned as rigid bodies to these poses (M, 4, 4)."""

    def at_poses(self, poses: Floats, **changes: Any) -> Self:
        """The scanner with its modules moved and turned as rigid bodies to these poses (M, 4, 4), and other `changes`."""
        return self.replace(**self.attributes_at(poses), **changes)

    @classmethod
    def aimed(cls, places: Floats) -> Floats | None:
        """The poses (M, 4, 4) in which modules at `places` (M, 3), mm, look at the isocentre; None if the kind has none."""
        return None

    @abstractmethod
    def views(
        self,
        shape: tuple[int, int] = (256, 256),
        detector: Detector = "virtual",
        magnification: float = 10.0,
        pitch: ArrayLike | None = None,
        offset: ArrayLike = (0.0, 0.0),
    ) -> Views:
        """The modules' images, of n_v rows and n_u columns, as the settings of a run ask for them."""

    @property
    def pixels(self) -> tuple[int, int] | None:
        """The pixels (n_v, n_u) of its images, if it has any of its own; runs have them unless their settings say others."""
        return None

    def fields(self) -> Floats:
        """What each module's camera sees, (M, 5), mm: `Views.fields` of its image."""
        return self.views((1, 1)).fields(self.poses())

    def parts(self, construction: Any = None) -> Sequence[ModulePart]:
        """The modules' solids for the scene and for files, built as a kind's `construction` says; none by default.

        A module has at most one part of each kind.
        """
        return ()

    def findings(
        self, others: Sequence[Scanner] = (), construction: Any = None, bore: float | None = None
    ) -> Sequence[Finding]:
        """What is wrong with its modules in one room with `others`, whose solids are built as a `construction` says.

        The patient lies within `bore`, mm, of the z axis, if that is given.
        """
        raise InputError(f"there are no checks of a scanner of the kind {self.kind}")

    def rings(self) -> Integers:
        """Index (M,) of each module's group, from 0; all are one by default."""
        return np.zeros(len(self), dtype=np.int64)

    def region_radius(self) -> float:
        """Radius, mm, of the sphere around the isocentre that is looked at: by default to halfway to the nearest source."""
        return float(np.linalg.norm(self.poses()[:, :3, 3], axis=1).min()) / 2


def first(bad: Bools) -> list[int]:
    """The first index that is bad, if any."""
    return [int(bad.argmax())] if bad.any() else []


def repeated(rows: Array) -> Bools:
    """Which rows (M,) of an array (M, ...) stand there before."""
    if len(rows) == 1:
        return np.zeros(1, bool)
    return first_equal(rows) != np.arange(len(rows))


def first_equal(rows: Array) -> Indexes:
    """The first row (M,) of an array (M, ...) that is equal to each."""
    _, places, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return places[inverse.reshape(-1)]


def rings_along_z(z: Floats, gaps: ArrayLike) -> Integers:
    """Index (M,) of each one's ring, from 0 along +z: those that differ less in z than the gap, one or (M,), form a ring."""
    order = np.argsort(z, kind="stable")
    rings = np.empty(len(z), np.int64)
    rings[order] = np.cumsum(np.diff(z[order], prepend=z[order[0]]) > np.broadcast_to(gaps, len(z))[order])
    return rings
