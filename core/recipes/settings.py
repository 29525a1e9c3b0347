"""Settings: the declaration of one entry of a recipe, from which options, files, panels and records follow."""

import dataclasses
import operator
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import InputError
from ..validation import real_array

Words = Mapping[str, tuple[str, str]]
"""Words that a setting allows, each with its label and its description."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """Declaration of one setting of a recipe."""

    key: str
    """Table and name, such as "model.time"."""
    kind: type
    """Type of the value, or of each of several: bool, int, float or str; list stands for a 4 x 4 matrix."""
    default: Any
    """Value of a recipe that does not give the setting; None for no value."""
    text: str
    """Description for help texts, a sentence without its full stop."""
    absent: str = ""
    """Consequence of leaving the setting out, for help texts, if `default` is None."""
    unit: str = ""
    """Unit of the value, such as "mm"."""
    words: Words = dataclasses.field(default_factory=dict)
    """Words that the value may be; a setting of numbers allows them beside numbers."""
    aliases: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Words of earlier versions, each with the word that has replaced it."""
    least: float | None = None
    """Smallest allowed number."""
    above: float | None = None
    """Number that the value must exceed."""
    most: float | None = None
    """Largest allowed number."""
    slider: float | None = None
    """Largest number that a slider reaches in Blender."""
    sizes: tuple[int, ...] | None = None
    """Allowed numbers of values, () for one or more; None for a single value, which is no list."""
    of_modules: bool = False
    """Whether the value may also be a list with a number for each module, or a text such as "10, 20"."""
    is_path: bool = False
    """Whether the value is the name of a file."""
    endings: Collection[str] = ()
    """Endings, in lower case, of files that the value may name instead of being one of `words`."""
    needs: tuple[str, ...] = ()
    """Conditions without which the setting has no effect; all must be met, see `values.is_met`."""
    option: str = ""
    """Option on the command line; by default made from the key."""
    label: str = ""
    """Name in Blender; by default made from the key."""
    unset: str = "Auto"
    """Word that Blender's panels show for a number that is not given."""

    def __post_init__(self) -> None:
        name = self.key.rpartition(".")[2].removesuffix("_degrees")
        object.__setattr__(self, "option", self.option or "--" + name.replace("_", "-"))
        object.__setattr__(self, "label", self.label or name.replace("_", " ").title())

    def with_key(self, key: str, row: "type[Setting] | None" = None, **changes: Any) -> "Setting":
        """Return this setting under another key, without its conditions, and with other `changes`.

        `row` is the class of the new setting, by default that of this one.
        """
        return (row or type(self))(**{**vars(self), "key": key, "needs": (), **changes})

    def names_file(self, value: Any) -> bool:
        """Return whether `value` is the name of a file."""
        if self.of_modules and isinstance(value, tuple):
            return False
        return self.is_path or (isinstance(value, str) and Path(value).suffix.lower() in self.endings)

    @property
    def help(self) -> str:
        """Description with unit, words and the consequence of leaving the setting out."""
        words_text = f"one of {', '.join(self.words)}" if self.words else ""
        description = ", ".join(filter(None, (self.text, self.unit, words_text)))
        return description + (f"; without it, {self.absent}" if self.absent else "")

    @property
    def expected(self) -> str:
        """Description of one allowed value, for messages after "expected"."""
        file_text = f"a file ({', '.join(self.endings)})" if self.endings else ""
        choices_text = " or ".join(filter(None, (f"one of {', '.join(self.words)}" if self.words else "", file_text)))
        if self.kind in (bool, str):
            return choices_text or {bool: "true or false", str: "a text"}[self.kind]
        number_text = "a whole number" if self.kind is int else "a number"
        bounds = {"of {:g} or more": self.least, "above {:g}": self.above, "and at most {:g}": self.most}
        number_text += "".join(" " + form.format(bound) for form, bound in bounds.items() if bound is not None)
        return " or ".join(filter(None, (choices_text, number_text + (f" ({self.unit})" if self.unit else ""))))

    def checked(self, value: Any) -> Any:
        """Return `value` as a recipe keeps it, lists as tuples; raise `InputError` if it is not allowed."""
        if self.kind is list:
            return tuple(map(tuple, real_array(value, self.key, (4, 4)).tolist()))
        if self.of_modules:
            return self._checked_of_modules(value)
        if self.sizes is None:
            return self.checked_one(value)
        values = value if isinstance(value, list | tuple) else [value]
        if not values or (self.sizes and len(values) not in self.sizes):
            sizes = " or ".join(map(str, self.sizes)) or "1 or more"
            raise InputError(f"{self.key}: expected {sizes} values, got {len(values)}")
        return tuple(map(self.checked_one, values))

    def _checked_of_modules(self, value: Any) -> Any:
        """Return the checked number for all modules, or a tuple of one number per module; a text may list them."""
        if isinstance(value, str) and not self.names_file(value):
            with suppress(ValueError):
                value = list(map(float, value.replace(",", " ").split()))
        if not isinstance(value, list | tuple):
            return self.checked_one(value)
        numbers = tuple(map(self.checked_one, value))
        if not numbers or any(isinstance(number, str) for number in numbers):
            raise InputError(f"{self.key}: expected {self.expected}, or a number for each module, got {value!r:.60}")
        return numbers if len(numbers) > 1 else numbers[0]

    def checked_one(self, value: Any) -> Any:
        """Return one value, a number as `kind`; raise `InputError` if it is not allowed."""
        if isinstance(value, str):
            value = self.aliases.get(value, value)
            has_choices = self.words or self.endings
            is_allowed = value in self.words or self.names_file(value) if has_choices else self.kind is str
        elif self.kind in (bool, str):
            is_allowed = isinstance(value, self.kind)
        else:
            bounds = ((self.least, operator.ge), (self.above, operator.gt), (self.most, operator.le))
            is_allowed = isinstance(value, Integral if self.kind is int else Real) and not isinstance(value, bool)
            is_allowed = is_allowed and abs(value) < 1e308
            is_allowed = is_allowed and all(bound is None or holds(value, bound) for bound, holds in bounds)
            value = self.kind(value) if is_allowed else value
        if not is_allowed:
            raise InputError(f"{self.key}: expected {self.expected}, got {value!r}")
        return value


@dataclasses.dataclass(frozen=True)
class UncheckedSetting(Setting):
    """Setting whose values are checked by the class that takes them as arguments."""

    def checked(self, value: Any) -> Any:
        """Return `value` as a recipe keeps it, lists as tuples."""
        value = value.tolist() if hasattr(value, "tolist") else value
        return tuple(value) if isinstance(value, list) else value


def default_setting(key: str, default: Any, text: str, row: type[Setting] = Setting, **details: Any) -> Setting:
    """Return a setting, of class `row`, of the type of its default; a tuple as default allows any number of values."""
    first, sizes = (default[0], ()) if isinstance(default, tuple) else (default, None)
    return row(key, type(first), default, text, sizes=sizes, **details)


class LibraryAlgorithm(NamedTuple):
    """Row of a table for `choice_setting`: an algorithm of a library, such as an optimiser of torch."""

    label: str
    """Name in menus."""
    text: str
    """Help text of one line."""
    name: str
    """Name of the algorithm in the library."""
    options: Mapping[str, float]
    """Options that the library gets, by its names for them."""


def choice_setting(key: str, table: Mapping[str, Any], text: str, **details: Any) -> tuple[Setting, ...]:
    """Return the setting of a choice among the rows of a table, or no setting while the table has a single row.

    The rows have the attributes `label` and `text`; the first one is the default. `Values.choice` returns the chosen name.
    """
    words = {name: (row.label, row.text) for name, row in table.items()}
    return (Setting(key, str, next(iter(table)), text, words=words, **details),) if len(table) > 1 else ()


def settings_by_key(settings: Iterable[Setting]) -> dict[str, Setting]:
    """Return settings by their keys."""
    return {setting.key: setting for setting in settings}


def table_names(settings: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the tables that settings stand in, in the order of their keys, such as "model.time"."""
    return tuple(dict.fromkeys(key.partition(".")[0] for key in settings))


def word_labels(names: Iterable[str], text: str = "") -> Words:
    """Return words that are their own labels, but for a capital at the start, with one description for all."""
    return {name: (name[0].upper() + name[1:], text) for name in names}


def alternatives(key: str, words: Iterable[str]) -> str:
    """Return the condition of `Setting.needs` that the setting `key` has one of these values."""
    return " or ".join(f"{key}={word}" for word in words)
