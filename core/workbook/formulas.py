"""Arithmetic of spreadsheet formulas, for files that store formulas without values (openpyxl writes such).

The libraries for this were weighed: `formulas` (EUPL) brings scipy and the compiled regex, `xlcalculator` pandas,
`pycel` a networkx of 2021. A geometry table needs arithmetic over cells: openpyxl's tokenizer and the precedence
below are enough.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

Lookup = Callable[[str | None, int, int], Any]
"""(sheet name or None for the formula's own, row, column) -> the cell's value, None if blank."""

_MAX_RANGE = 100_000


class CellError(str):
    """An error value such as #REF! or #DIV/0!."""


class NotComputable(Exception):
    """The formula needs something that is not here; the message says what."""


def evaluate(formula: str, lookup: Lookup) -> float | CellError:
    """The number that `formula` (with its "=") gives, or the error value, e.g. #REF!, of a cell it refers to.

    Raises
    ------
    NotComputable
        It uses a function, name or value beyond arithmetic.
    ArithmeticError, ValueError
        Where the spreadsheet would show #DIV/0! or #NUM!.
    """
    from openpyxl.formula import Tokenizer
    from openpyxl.formula.tokenizer import TokenizerError

    try:
        tokens = [token for token in Tokenizer(formula).items if token.type != "WHITE-SPACE"]
    except (TokenizerError, IndexError) as error:  # the latter where a parenthesis closes nothing
        raise NotComputable("it is not a formula") from error
    try:
        return _number(_Parser(tokens, lookup).whole())
    except _ErrorValue as error:
        return error.args[0]


class _ErrorValue(Exception):
    """An operand is an error value; so is the result."""


def _number(value: Any) -> float:
    if isinstance(value, list):
        if len(value) != 1:
            raise NotComputable("it uses a range where one cell belongs")
        value = value[0]
    if value is None:
        return 0.0
    if isinstance(value, CellError):
        raise _ErrorValue(value)
    if isinstance(value, (int, float)):
        return float(value)
    raise NotComputable(f"it refers to {str(value)!r}, not a number")


def _numbers(arguments: list[Any]) -> list[float]:
    """All numbers in the arguments; in ranges, blank cells and text do not count, as in a spreadsheet."""
    found = []
    for argument in arguments:
        cells = argument if isinstance(argument, list) and len(argument) > 1 else [argument]
        skipped = (type(None), str) if cells is argument else ()
        found += [_number(cell) for cell in cells if isinstance(cell, CellError) or not isinstance(cell, skipped)]
    return found


def _atan2(x: float, y: float) -> float:
    if x == y == 0:
        raise ZeroDivisionError
    return math.atan2(y, x)


def _power(base: float, exponent: float) -> float:
    result = base**exponent
    if isinstance(result, complex):
        raise ValueError("no real power")
    return result


def _round(value: float, digits: float) -> float:
    scale = 10.0 ** int(digits)
    return math.copysign(math.floor(abs(value) * scale + 0.5) / scale, value)


_OF_NUMBERS: dict[str, tuple[int, Callable[..., float]]] = {
    "ABS": (1, abs),
    "ACOS": (1, math.acos),
    "ASIN": (1, math.asin),
    "ATAN": (1, math.atan),
    "ATAN2": (2, _atan2),  # x comes first
    "COS": (1, math.cos),
    "DEGREES": (1, math.degrees),
    "PI": (0, lambda: math.pi),
    "POWER": (2, _power),
    "RADIANS": (1, math.radians),
    "ROUND": (2, _round),
    "SIN": (1, math.sin),
    "SQRT": (1, math.sqrt),
    "TAN": (1, math.tan),
}
_OF_RANGES: dict[str, Callable[[list[float]], float]] = {
    "AVERAGE": lambda xs: math.fsum(xs) / len(xs),
    "MAX": lambda xs: max(xs, default=0.0),
    "MIN": lambda xs: min(xs, default=0.0),
    "PRODUCT": math.prod,
    "SUM": math.fsum,
    "SUMSQ": lambda xs: math.fsum(x * x for x in xs),
}
# Loosest first; all group from the left, and a minus sign in front binds tightest: -2^2 is 4.
_OPERATORS: list[dict[str, Callable[[float, float], float]]] = [
    {"+": lambda a, b: a + b, "-": lambda a, b: a - b},
    {"*": lambda a, b: a * b, "/": lambda a, b: a / b},
    {"^": _power},
]
_REFERENCE = re.compile(
    r"(?:(?P<sheet>'(?:[^']|'')+'|[^'!]+)!)?\$?(?P<column>[A-Z]{1,3})\$?(?P<row>\d{1,7})"
    r"(?::\$?(?P<last_column>[A-Z]{1,3})\$?(?P<last_row>\d{1,7}))?",
    re.IGNORECASE,
)


class _Parser:
    def __init__(self, tokens: list[Any], lookup: Lookup) -> None:
        self.tokens = tokens
        self.lookup = lookup
        self.at = 0

    def whole(self) -> Any:
        value = self.operation(0)
        if self.at < len(self.tokens):
            raise NotComputable(f"it uses {self.tokens[self.at].value!r}")
        return value

    def is_next(self, kind: str, subtype: str = "") -> bool:
        if self.at == len(self.tokens):
            return False
        token = self.tokens[self.at]
        return token.type == kind and (not subtype or token.subtype == subtype)

    def take(self) -> Any:
        if self.at == len(self.tokens):
            raise NotComputable("it ends too early")
        self.at += 1
        return self.tokens[self.at - 1]

    def operation(self, level: int) -> Any:
        if level == len(_OPERATORS):
            return self.signed()
        left = self.operation(level + 1)
        while self.is_next("OPERATOR-INFIX") and self.tokens[self.at].value in _OPERATORS[level]:
            operator = _OPERATORS[level][self.take().value]
            left = operator(_number(left), _number(self.operation(level + 1)))
        return left

    def signed(self) -> Any:
        if self.is_next("OPERATOR-PREFIX"):
            sign = -1.0 if self.take().value == "-" else 1.0
            return sign * _number(self.signed())
        value = self.operand()
        while self.is_next("OPERATOR-POSTFIX"):
            self.take()
            value = _number(value) / 100
        return value

    def operand(self) -> Any:
        token = self.take()
        if token.type == "OPERAND" and token.subtype == "NUMBER":
            return float(token.value)
        if token.type == "OPERAND" and token.subtype == "RANGE":
            return self.cells(token.value)
        if token.type == "OPERAND" and token.subtype == "ERROR":
            raise _ErrorValue(CellError(token.value))
        if token.type == "PAREN" and token.subtype == "OPEN":
            value = self.operation(0)
            self.close("PAREN")
            return value
        if token.type == "FUNC" and token.subtype == "OPEN":
            return self.call(token.value[:-1].upper())
        raise NotComputable(f"it uses {token.value!r}")

    def call(self, name: str) -> float:
        if name not in _OF_NUMBERS and name not in _OF_RANGES:
            raise NotComputable(f"it uses the function {name}")
        arguments = []
        while not self.is_next("FUNC", "CLOSE"):
            arguments.append(self.operation(0))
            if not self.is_next("SEP"):
                break
            self.take()
        self.close("FUNC")
        if name in _OF_RANGES:
            return _OF_RANGES[name](_numbers(arguments))
        count, function = _OF_NUMBERS[name]
        if len(arguments) != count:
            raise NotComputable(f"{name} has {len(arguments)} arguments instead of {count}")
        return function(*(_number(argument) for argument in arguments))

    def close(self, kind: str) -> None:
        if not self.is_next(kind, "CLOSE"):
            raise NotComputable("a parenthesis is not closed")
        self.take()

    def cells(self, reference: str) -> Any:
        from openpyxl.utils import column_index_from_string

        match = _REFERENCE.fullmatch(reference)
        if match is None or "[" in reference:
            raise NotComputable(f"it uses {reference}")
        sheet = match["sheet"]
        if sheet is not None and sheet.startswith("'"):
            sheet = sheet[1:-1].replace("''", "'")
        column, row = column_index_from_string(match["column"]), int(match["row"])
        if match["last_column"] is None:
            return self.lookup(sheet, row, column)
        last_column, last_row = column_index_from_string(match["last_column"]), int(match["last_row"])
        if (abs(last_row - row) + 1) * (abs(last_column - column) + 1) > _MAX_RANGE:
            raise NotComputable(f"it uses the large range {reference}")
        return [
            self.lookup(sheet, r, c)
            for r in range(min(row, last_row), max(row, last_row) + 1)
            for c in range(min(column, last_column), max(column, last_column) + 1)
        ]
