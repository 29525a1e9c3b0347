"""An evaluator of spreadsheet formulas: arithmetic over cells and a little logic, without the dependencies of a library.

A formula that needs more raises `NotComputable`; nothing is guessed.
"""

import decimal
import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from .sheet_xml import At, CellError, Reference, reference

_MAX_RANGE = 100_000


class NotComputable(Exception):
    """The formula needs something that is not known here; the message says what."""


@dataclass(frozen=True)
class Surroundings:
    """What a formula refers to; each sheet is given by its name, or None for the formula's own."""

    lookup: Callable[[str | None, int, int], Any]
    """(sheet, row, column) -> the cell's value, None if blank."""
    at: At | None = None
    """The formula's own cell, for ``ROW()``."""
    extent: Callable[[str | None], At] | None = None
    """Sheet -> its last row and column with content, at which whole columns and rows end."""
    name: Callable[[str], str | None] = lambda _: None
    """Defined name -> its formula, None if unknown."""


def calculate(formula: str, surroundings: Surroundings) -> float | str | bool | CellError:
    """What a spreadsheet shows for `formula` (with its "="), or `NotComputable`."""
    try:
        value = _scalar(_Parser(formula, surroundings).value())
    except _ErrorValue as error:
        return error.args[0]
    except ZeroDivisionError:
        return CellError("#DIV/0!")
    except (ArithmeticError, ValueError):
        return CellError("#NUM!")
    except RecursionError as error:
        raise NotComputable("it is nested too deeply") from error
    if isinstance(value, float) and not math.isfinite(value):
        return CellError("#NUM!")
    return 0.0 if value is None else value


@lru_cache(maxsize=2**15)  # each is asked for twice: for what a formula refers to, and for its value
def tokens_of(formula: str) -> tuple[Any, ...]:
    """The tokens (`openpyxl.formula.tokenizer.Token`) of `formula`; `NotComputable` if it is malformed."""
    from openpyxl.formula import Tokenizer
    from openpyxl.formula.tokenizer import TokenizerError

    try:
        return tuple(token for token in Tokenizer(formula).items if token.type != "WHITE-SPACE")
    except (TokenizerError, IndexError) as error:  # the latter for a parenthesis that closes nothing
        raise NotComputable("it is not a formula") from error


def operands(formula: str) -> list[str]:
    """The references and names in a formula, none if it is malformed."""
    try:
        return [token.value for token in tokens_of(formula) if (token.type, token.subtype) == ("OPERAND", "RANGE")]
    except NotComputable:
        return []


def areas_in(formula: str) -> list[Reference]:
    """The areas that a formula names."""
    return [area for text in operands(formula) if (area := reference(text)) is not None]


class _ErrorValue(Exception):
    """The value of an operand is an error, and so is the result."""


class _Cells(list):  # type: ignore[type-arg]
    """The values of an area, row by row."""

    def __init__(self, values: list[Any], columns: int, first: tuple[int, int]) -> None:
        super().__init__(values)
        self.columns, self.first = columns, first


_Term = Callable[[], Any]
"""A part of a formula, computed when called: the branch of an IF that is not taken must not be computed."""


def _no_error(value: Any) -> Any:
    if isinstance(value, CellError):
        raise _ErrorValue(value)
    return value


def _scalar(value: Any) -> Any:
    if isinstance(value, _Cells):
        if len(value) != 1:
            raise NotComputable("it uses a range where one cell belongs")
        value = value[0]
    return _no_error(value)


def _number(value: Any) -> float:
    value = _scalar(value)
    if value is None:
        return 0.0
    if isinstance(value, (int, float)):
        return float(value)
    if value == "":
        raise _ErrorValue(CellError("#VALUE!"))
    raise NotComputable(f"it refers to {str(value)!r}, not a number")


def _text(value: Any) -> str:
    value = _scalar(value)
    if isinstance(value, bool):
        return str(value).upper()
    if isinstance(value, float):
        if value and not 1e-4 <= abs(value) < 1e15:
            raise NotComputable(f"it makes a text of {value:g}")
        return f"{value:.15g}"
    return "" if value is None else str(value)


def _truth(value: Any) -> bool:
    value = _scalar(value)
    if isinstance(value, str):
        if value.upper() in ("TRUE", "FALSE"):
            return value.upper() == "TRUE"
        raise _ErrorValue(CellError("#VALUE!"))
    return bool(value)


def _area(term: _Term) -> _Cells:
    value = term()
    if not isinstance(value, _Cells):
        raise NotComputable("it uses a value where a range belongs")
    return value


def _numbers(terms: list[_Term]) -> list[float]:
    """The numbers among the cells of areas, and every other argument as a number."""
    found = []
    for value in [term() for term in terms]:
        if isinstance(value, _Cells):
            found += [cell for cell in map(_no_error, value) if type(cell) is float]
        else:
            found.append(_number(value))
    return found


def _same_as_shown(a: float, b: float) -> bool:
    """Whether numbers agree in the 15 digits that spreadsheets show and compare: 0.1 + 0.2 is 0.3."""
    return f"{a:.14e}" == f"{b:.14e}"


def _compared(compare: Callable[[Any, Any], bool]) -> Callable[[Any, Any], bool]:
    """A comparison: numbers are less than texts (case aside), texts less than booleans; a blank is the other's zero."""

    def rank(value: Any) -> tuple[int, Any]:
        if isinstance(value, bool):
            return 2, value
        return (1, value.casefold()) if isinstance(value, str) else (0, value)

    def result(a: Any, b: Any) -> bool:
        a, b = _scalar(a), _scalar(b)
        zero = {str: "", bool: False}
        a = zero.get(type(b), 0.0) if a is None else a
        b = zero.get(type(a), 0.0) if b is None else b
        if type(a) is type(b) is float and _same_as_shown(a, b):
            b = a
        return compare(rank(a), rank(b))

    return result


def _of_two_numbers(function: Callable[[float, float], float]) -> Callable[[Any, Any], float]:
    return lambda a, b: function(_number(a), _number(b))


def _sum(a: float, b: float) -> float:
    return 0.0 if _same_as_shown(a, -b) else a + b


def _power(base: float, exponent: float) -> float:
    result = base**exponent
    if isinstance(result, complex):
        raise ValueError("no real power")
    return result


_COMPARISONS = {"=": "eq", "<>": "ne", "<": "lt", "<=": "le", ">": "gt", ">=": "ge"}  # names in `operator`
# From loosest to tightest; all group from the left, and a sign in front binds tighter: -2^2 is 4.
_OPERATORS: list[dict[str, Callable[[Any, Any], Any]]] = [
    {sign: _compared(getattr(operator, name)) for sign, name in _COMPARISONS.items()},
    {"&": lambda a, b: _text(a) + _text(b)},
    {"+": _of_two_numbers(_sum), "-": _of_two_numbers(lambda a, b: _sum(a, -b))},
    {"*": _of_two_numbers(operator.mul), "/": _of_two_numbers(operator.truediv)},
    {"^": _of_two_numbers(_power)},
]


def _atan2(x: float, y: float) -> float:
    if x == y == 0:
        raise ZeroDivisionError
    return math.atan2(y, x)


def _rounded(rounding: str) -> Callable[[float, float], float]:
    def function(value: float, digits: float) -> float:
        # Spreadsheets round the decimals that they show, not the binary digits: ROUND(2.675,2) is 2.68.
        step = decimal.Decimal(1).scaleb(-int(digits))
        with decimal.localcontext(prec=400):
            return float(decimal.Decimal(f"{value:.15g}").quantize(step, rounding=rounding))

    return function


def _truths(first: _Term, *more: _Term) -> list[bool]:
    values = [_scalar(term()) for term in (first, *more)]
    if not all(isinstance(value, (bool, float)) for value in values):
        raise NotComputable("it uses a text or a blank as a truth value")
    return [bool(value) for value in values]


def _if(condition: _Term, then: _Term, otherwise: _Term = lambda: False) -> Any:
    return _scalar((then if _truth(condition()) else otherwise)())


def _if_error(value: _Term, otherwise: _Term) -> Any:
    try:
        return _scalar(value())
    except (_ErrorValue, ArithmeticError, ValueError):
        return _scalar(otherwise())


def _index(cells: _Term, row: _Term, column: _Term = lambda: None) -> Any:
    area, wanted = _area(cells), column()
    i, j = int(_number(row())), 1 if wanted is None else int(_number(wanted))
    if wanted is None and len(area) == area.columns:  # in one row, the only index counts columns
        i, j = 1, i
    elif wanted is None and area.columns > 1:
        raise _ErrorValue(CellError("#REF!"))
    if i == 0 or j == 0:
        raise NotComputable("it uses a whole row or column of a range")
    if i < 0 or j < 0 or j > area.columns or i > len(area) // area.columns:
        raise _ErrorValue(CellError("#REF!" if i > 0 and j > 0 else "#VALUE!"))
    return _scalar(area[(i - 1) * area.columns + j - 1])


def _position(wanted: Any, cells: list[Any], mode: Any) -> int:
    """The index of the first cell that equals `wanted`; `mode` is the last argument of MATCH or VLOOKUP."""
    wanted = _scalar(wanted)
    if _number(mode) != 0:
        raise NotComputable("it looks up the nearest value")
    if isinstance(wanted, str) and set(wanted) & set("*?~"):
        raise NotComputable("it looks for a pattern")
    same = _compared(operator.eq)
    for i, cell in enumerate(cells):
        if cell is not None and not isinstance(cell, CellError) and same(wanted, cell):
            return i
    raise _ErrorValue(CellError("#N/A"))


def _vlookup(wanted: _Term, cells: _Term, column: _Term, mode: _Term = lambda: 1.0) -> Any:
    area, j = _area(cells), int(_number(column()))
    if not 1 <= j <= area.columns:
        raise _ErrorValue(CellError("#REF!" if j > 0 else "#VALUE!"))
    return _scalar(area[_position(wanted(), area[:: area.columns], mode()) * area.columns + j - 1])


_OF_NUMBERS: dict[str, Callable[..., float]] = {
    name: getattr(math, name.lower())
    for name in ("ACOS", "ASIN", "ATAN", "COS", "DEGREES", "EXP", "LOG10", "RADIANS", "SIN", "SQRT", "TAN")
} | {
    "ABS": abs,
    "ATAN2": _atan2,  # x comes first
    "INT": math.floor,
    "LN": lambda x: math.log(x),
    "LOG": lambda x, base=10.0: math.log10(x) if base == 10 else math.log(x) / math.log(base),
    "MOD": lambda x, divisor: x - divisor * math.floor(x / divisor),
    "PI": lambda: math.pi,
    "POWER": _power,
    "ROUND": _rounded(decimal.ROUND_HALF_UP),
    "ROUNDDOWN": _rounded(decimal.ROUND_DOWN),
    "ROUNDUP": _rounded(decimal.ROUND_UP),
    "SIGN": lambda x: (x > 0) - (x < 0),
}
_OF_RANGES: dict[str, Callable[[list[float]], float]] = {
    "AVERAGE": lambda xs: math.fsum(xs) / len(xs),
    "MAX": lambda xs: max(xs, default=0.0),
    "MIN": lambda xs: min(xs, default=0.0),
    "PRODUCT": lambda xs: math.prod(xs) if xs else 0.0,
    "SUM": math.fsum,
    "SUMSQ": lambda xs: math.fsum(x * x for x in xs),
}
_OF_TERMS: dict[str, Callable[..., Any]] = {
    "AND": lambda *terms: all(_truths(*terms)),
    "COUNT": lambda cells: float(sum(type(cell) is float for cell in _area(cells))),
    "COUNTA": lambda cells: float(sum(cell is not None for cell in _area(cells))),
    "FALSE": lambda: False,
    "IF": _if,
    "IFERROR": _if_error,
    "INDEX": _index,
    "MATCH": lambda wanted, cells, mode=lambda: 1.0: _position(wanted(), _area(cells), mode()) + 1.0,
    "NOT": lambda term: not _truth(term()),
    "OR": lambda *terms: any(_truths(*terms)),
    "TRUE": lambda: True,
    "VLOOKUP": _vlookup,
}


class _Parser:
    """A recursive descent through a formula's tokens; its methods return the terms that they pass."""

    def __init__(self, formula: str, surroundings: Surroundings) -> None:
        self.tokens, self.surroundings, self.at = tokens_of(formula), surroundings, 0

    def value(self) -> Any:
        term = self.operation(0)
        if self.at < len(self.tokens):
            raise NotComputable(f"it uses {self.tokens[self.at].value!r}")
        return term()

    def is_next(self, kind: str, subtype: str = "") -> bool:
        token = self.tokens[self.at] if self.at < len(self.tokens) else None
        return token is not None and token.type == kind and subtype in ("", token.subtype)

    def take(self) -> Any:
        if self.at == len(self.tokens):
            raise NotComputable("it ends too early")
        self.at += 1
        return self.tokens[self.at - 1]

    def close(self, kind: str) -> None:
        if not self.is_next(kind, "CLOSE"):
            raise NotComputable("a parenthesis is not closed")
        self.take()

    def operation(self, level: int) -> _Term:
        if level == len(_OPERATORS):
            return self.signed()
        left = self.operation(level + 1)
        while self.is_next("OPERATOR-INFIX") and self.tokens[self.at].value in _OPERATORS[level]:
            left = _applied(_OPERATORS[level][self.take().value], left, self.operation(level + 1))
        return left

    def signed(self) -> _Term:
        if self.is_next("OPERATOR-PREFIX"):
            sign = -1.0 if self.take().value == "-" else 1.0
            term = self.signed()
            return lambda: sign * _number(term())
        term = self.operand()
        while self.is_next("OPERATOR-POSTFIX"):
            self.take()
            term = _applied(_of_two_numbers(operator.truediv), term, lambda: 100.0)
        return term

    def operand(self) -> _Term:
        token = self.take()
        text, kind = token.value, (token.type, token.subtype)
        if kind == ("PAREN", "OPEN"):
            term = self.operation(0)
            self.close("PAREN")
            return term
        if kind == ("FUNC", "OPEN"):
            return self.call(text[:-1].upper().removeprefix("_XLFN."))
        if kind == ("OPERAND", "RANGE"):
            return lambda: self.cells(text)
        if kind[0] != "OPERAND":
            raise NotComputable(f"it uses {text!r}")
        if kind[1] == "NUMBER":
            return lambda: float(text)
        if kind[1] == "TEXT":
            return lambda: text[1:-1].replace('""', '"')
        return lambda: text.upper() == "TRUE" if kind[1] == "LOGICAL" else CellError(text)

    def call(self, name: str) -> _Term:
        terms: list[_Term] = []
        while not self.is_next("FUNC", "CLOSE"):
            missing = self.is_next("SEP")  # IF(A1,,2)
            terms.append((lambda: None) if missing else self.operation(0))
            if not self.is_next("SEP"):
                break
            self.take()
        self.close("FUNC")
        return lambda: self.called(name, terms)

    def called(self, name: str, terms: list[_Term]) -> Any:
        if name in ("ROW", "COLUMN") and len(terms) < 2:
            at = _area(terms[0]).first if terms else self.surroundings.at
            if at is not None:
                return float(at[name == "COLUMN"])
        if name in _OF_RANGES:
            return float(_OF_RANGES[name](_numbers(terms)))
        try:
            if name in _OF_NUMBERS:
                return float(_OF_NUMBERS[name](*(_number(term()) for term in terms)))
            if name in _OF_TERMS:
                return _OF_TERMS[name](*terms)
        except TypeError as error:
            raise NotComputable(f"it uses {name} with {len(terms)} arguments") from error
        raise NotComputable(f"it uses the function {name}")

    def cells(self, text: str) -> Any:
        area = reference(text)
        if area is None:
            formula = self.surroundings.name(text)
            if formula is None:
                raise NotComputable(f"it uses {text}")
            return _Parser(formula, self.surroundings).value()
        sheet, top, left, bottom, right = area
        if sheet is not None and ":" in sheet:
            raise NotComputable(f"it uses {text}, through several sheets")
        if self.surroundings.extent and area.size > _MAX_RANGE:
            last_row, last_column = self.surroundings.extent(sheet)  # beyond which all cells are blank
            bottom, right = max(top, min(bottom, last_row)), max(left, min(right, last_column))
        if (bottom - top + 1) * (right - left + 1) > _MAX_RANGE:
            raise NotComputable(f"it uses the large range {text}")
        rows, columns = range(top, bottom + 1), range(left, right + 1)
        values = [self.surroundings.lookup(sheet, row, column) for row in rows for column in columns]
        return _Cells(values, len(columns), (top, left))


def _applied(function: Callable[[Any, Any], Any], left: _Term, right: _Term) -> _Term:
    return lambda: function(left(), right())
