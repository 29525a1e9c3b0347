"""Base class of the kinds of scanners: a table of columns with a row for each module, its views, solids and source file.

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
from .module_parts import ModulePart
from .views import Views

Detector = Literal["virtual", "real"]

Fault = tuple[str, int, str]
"""Name of the column at fault, index of the module, and the problem as a phrase that follows the cell's address."""

SCANNERS: dict[str, type[Scanner]] = {}
"""Classes of the kinds of scanners by name; a class enters itself when it is defined."""

_signature = lru_cache(signature)  # cached, because `signature` is slow


class Finding:
    """Something wrong with one module or with a pair of modules; ``str`` gives it in one line."""

    message: ClassVar[str]

    def __str__(self) -> str:
        return self.message.format(self)

    @property
    def modules(self) -> tuple[int, ...]:
        """Numbers of the modules concerned."""
        return tuple(getattr(self, name) for name in ("first", "second", "module", "by") if hasattr(self, name))


class Scanner(ABC):
    """Scanner of M modules of one kind; a subclass is a frozen dataclass whose fields hold the values of its columns.

    The fields are the attributes that the columns name (`Column.field`), and ``numbers``, ``source`` and ``more``. A value
    in ``more`` can be read as an attribute, too.
    """

    kind: ClassVar[str]
    """Name of the kind in run files and in the scene, such as "pinhole"."""
    sheet: ClassVar[str] = ""
    """Name of the one sheet of a workbook that holds the scanner; "" if its sheets are recognised by their headings."""
    word: ClassVar[str] = "Module"
    """Noun for a module in the scene, as in "Module 07"."""
    takes: ClassVar[tuple[str, ...]] = ("activity", "mu")
    """Quantities of the volumes that the scanner can image."""
    columns: ClassVar[ColumnTable]
    """Columns of the kind's table."""
    numbers: Integers
    """Numbers (M,) of the modules, by default 1, 2, ..."""
    source: SystemSource | None
    """Workbook that the scanner was read from, if any."""
    more: Mapping[str, Any]
    """Values of the columns that are no field of the class, by the columns' `field`."""

    def __init_subclass__(cls, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        if "kind" in vars(cls):
            SCANNERS[cls.kind] = cls

    def __post_init__(self) -> None:
        attributes, more = vars(self), dict[str, Any]()
        names = attributes.keys() | self.more.keys()
        n: int | None = None
        if unknown := self.more.keys() - self.columns.fields.keys():
            raise InputError(f"{sorted(unknown)[0]}: is no column of a {self.kind} scanner")
        for name, (column, *_) in self.columns.fields.items():
            values = getattr(self, name) if name in names else column.default(self.columns.needed_values(self))
            target = attributes if name in attributes else more
            target[name] = freeze(column.check_values(values, n))
            if (n := len(target[name])) == 0:
                raise InputError(f"a {self.kind} system needs at least one module, got none")
        listed = np.arange(1, (n or 0) + 1) if self.numbers is None else self.numbers
        numbers = freeze(real_array(listed, "numbers", (n,), np.int64))
        if not np.array_equal(numbers, listed):
            raise InputError("numbers: expected whole numbers")
        attributes.update(more=more, numbers=numbers)
        for name, column in self.columns.scalars.items():
            if column.plausible[0] > 0:
                unit = next(iter(column.units))
                self._refuse(getattr(self, name) <= 0, f"{name} must be more than 0 {unit}, got {{{name}:g}}")
        self._refuse(repeated_rows(numbers[:, None]), "another module has the same number")

    def __getattr__(self, name: str) -> Any:
        if name != "more" and name in self.more:
            return self.more[name]
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int | slice | Array) -> Self:
        """Return the scanner of some modules; `index` is an index from 0, a slice, or an array of indices or booleans."""
        chosen = np.atleast_1d(np.arange(len(self))[index])
        if len(chosen) == 0:
            raise InputError(f"no module chosen: there are {len(self)}")
        changes = {name: getattr(self, name)[chosen] for name in self.columns.fields}
        return self.replace(**changes, numbers=self.numbers[chosen])

    def replace(self, **changes: Any) -> Self:
        """Return a scanner that differs in the values of these attributes, which may be columns in `more`."""
        attributes = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        return self.of({**attributes.pop("more"), **attributes, **changes})

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Return the scanner with these attributes; columns without a field of the class are put into `more`."""
        names = _signature(cls).parameters
        more = {name: value for name, value in values.items() if name not in names}
        return cls(**{name: value for name, value in values.items() if name in names}, more=more)  # type: ignore[call-arg]

    @classmethod
    def from_values(cls, values: Values, numbers: ArrayLike | None = None, source: SystemSource | None = None) -> Self:
        """Return the scanner whose typed columns have these `values` (M,), mm, rad or texts.

        Optional columns may be missing, if their cells are all blank.
        """
        attributes: dict[str, Any] = {"numbers": numbers, "source": source}
        for name, columns in cls.columns.fields.items():
            present = {column.name: values[column.name] for column in columns if column.name in values}
            if present and columns[0].axis is None:
                attributes[name] = present[columns[0].name]
            elif present:
                zeros = np.zeros(len(next(iter(present.values()))))
                attributes[name] = np.stack([present.get(column.name, zeros) for column in columns], axis=1)
        return cls.of(attributes)

    def values(self) -> dict[str, Array]:
        """Return the values (M,) of the typed columns by name, mm, rad or texts."""
        return {name: self.columns[name].values(self) for name in self.columns.typed}

    def filled(self) -> dict[str, Array]:
        """Return the attributes with values of columns, without those that a workbook could leave blank for all modules."""
        typed = [self.columns[name] for name in self.columns.typed]
        used = {column.field for column in typed if not column.is_unused(self)}
        return {name: getattr(self, name) for name in self.columns.fields if name in used}

    @classmethod
    def faults(cls, values: Values, numbers: Sequence[int], place: Callable[[str, int], str]) -> Iterator[Fault]:
        """Yield the reasons for which `values` of the needed columns, all positive, are those of no scanner of this kind.

        A reason is given for the first module that has it. `numbers` are the modules' numbers; ``place(column, index)`` is
        the address of a module's cell, for messages.
        """
        yield from ()

    def _refuse(self, bad: Bools, message: str) -> None:
        """Raise `InputError` for the first module of the mask `bad`; `message` is a template of its attributes."""
        for i in first_true(bad):
            attributes = {name: np.ravel(getattr(self, name))[i] for name in re.findall(r"{(\w+)", message)}
            raise InputError(f"module {self.numbers[i]}: {message.format(**attributes)}")

    @abstractmethod
    def poses(self) -> Floats:
        """Return the poses (M, 4, 4), world from module: columns u, v, k, k normal to the image, and the source, mm."""

    def frames(self) -> Floats:
        """Return the module frames (M, 3, 3), rows u, v, k."""
        return self.poses()[:, :3, :3].transpose(0, 2, 1)

    @abstractmethod
    def attributes_at(self, poses: Floats) -> Mapping[str, Array]:
        """Return the attributes that change if the modules are moved as rigid bodies to these poses (M, 4, 4)."""

    def at_poses(self, poses: Floats, **changes: Any) -> Self:
        """Return the scanner with its modules moved as rigid bodies to these poses (M, 4, 4), and with other `changes`."""
        return self.replace(**self.attributes_at(poses), **changes)

    @classmethod
    def aimed(cls, places: Floats) -> Floats | None:
        """Return the poses (M, 4, 4) in which modules at `places` (M, 3), mm, look at the isocentre.

        Returns None for a kind whose modules have no such pose.
        """
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
        """Return the views of the modules' images, with the arguments that the settings of a run have.

        A kind of scanner ignores arguments that do not apply to it. `shape` is (n_v, n_u), `pitch` and `offset` are in mm.
        """

    @property
    def pixels(self) -> tuple[int, int] | None:
        """Numbers of pixels (n_v, n_u) that the scanner's images have unless a run's settings differ; None without any."""
        return None

    def fields(self) -> Floats:
        """Return the field of view of each module's camera, (M, 5), mm: `Views.fields` of its image."""
        return self.views((1, 1)).fields(self.poses())

    def parts(self, construction: Any = None) -> Sequence[ModulePart]:
        """Return the modules' solids for the scene and for files; by default there are none.

        `construction` has the kind's own settings of the solids. A module has at most one part of each kind.
        """
        return ()

    def findings(
        self, others: Sequence[Scanner] = (), construction: Any = None, bore: float | None = None
    ) -> Sequence[Finding]:
        """Return the mechanical problems (overlaps, blocked views) of these modules among `others` in the same room.

        The solids of the others are built according to `construction`. The patient lies within `bore`, mm, of the z axis, if
        that is given.
        """
        raise InputError(f"there are no checks of a scanner of the kind {self.kind}")

    def rings(self) -> Integers:
        """Return the index (M,) of each module's ring, from 0; by default all modules are in one."""
        return np.zeros(len(self), dtype=np.int64)

    def roi_radii(self) -> Floats:
        """Return the radii (M,), mm, of the modules' regions of interest; by default all are `region_radius`."""
        return np.full(len(self), self.region_radius())

    def derived_lengths(self) -> Mapping[str, Floats]:
        """Return lengths (M,), mm, by name that files hold besides the columns, from which they follow; by default none."""
        return {}

    def region_radius(self) -> float:
        """Return the radius, mm, of the imaged sphere around the isocentre; by default half of the least source distance."""
        return float(np.linalg.norm(self.poses()[:, :3, 3], axis=1).min()) / 2


def first_true(mask: Bools) -> list[int]:
    """Return a list with the index of the first True in `mask` (M,), or an empty list."""
    return [int(mask.argmax())] if mask.any() else []


def repeated_rows(rows: Array) -> Bools:
    """Return the mask (M,) of the rows of an array (M, ...) that repeat an earlier row."""
    if len(rows) == 1:
        return np.zeros(1, bool)
    return first_equal_row(rows) != np.arange(len(rows))


def first_equal_row(rows: Array) -> Indexes:
    """Return for each row of an array (M, ...) the index (M,) of the first row that equals it."""
    _, first_rows, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return first_rows[inverse.reshape(-1)]


def rings_along_z(z: Floats, gaps: ArrayLike) -> Integers:
    """Group modules into rings: sort by z and start a new ring where the step is larger than `gaps`, one or (M,), mm.

    Returns the index (M,) of each module's ring, from 0 along +z.
    """
    order = np.argsort(z, kind="stable")
    rings = np.empty(len(z), np.int64)
    rings[order] = np.cumsum(np.diff(z[order], prepend=z[order[0]]) > np.broadcast_to(gaps, len(z))[order])
    return rings
