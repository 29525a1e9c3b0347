"""Evaluator of spreadsheet formulas: arithmetic over cells and a little logic, without a library and its dependencies.

A formula that needs more raises `NotComputable`; nothing is guessed.
"""

import decimal
import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from .sheet_xml import CellError, Position, Reference, parse_reference

_MAX_RANGE = 100_000
"""Largest number of cells in an area that a formula reads."""


class NotComputable(Exception):
    """The formula needs something that is not known here; the message says what."""


@dataclass(frozen=True)
class FormulaContext:
    """Cells and names that a formula can refer to; the sheet None stands for the formula's own sheet."""

    lookup: Callable[[str | None, int, int], Any]
    """(sheet, row, column) -> value of the cell, None if blank."""
    position: Position | None = None
    """Row and column of the formula's own cell, for ``ROW()``."""
    extent: Callable[[str | None], Position] | None = None
    """Sheet -> its last row and its last column with content, at which whole columns and rows end."""
    name: Callable[[str], str | None] = lambda _: None
    """Defined name -> its formula, None if unknown."""


def calculate(formula: str, context: FormulaContext) -> float | str | bool | CellError:
    """Return the value that a spreadsheet shows for `formula`, which begins with "=".

    Raise `NotComputable` for a formula that this package cannot compute.
    """
    try:
        value = _to_scalar(FormulaParser(formula, context).value())
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


@lru_cache(maxsize=2**15)  # each formula is tokenized twice: for the cells that it refers to, and for its value
def tokenize_formula(formula: str) -> tuple[Any, ...]:
    """Return the tokens (`openpyxl.formula.tokenizer.Token`) of a formula; raise `NotComputable` if it is malformed."""
    from openpyxl.formula import Tokenizer
    from openpyxl.formula.tokenizer import TokenizerError

    try:
        return tuple(token for token in Tokenizer(formula).items if token.type != "WHITE-SPACE")
    except (TokenizerError, IndexError) as error:  # openpyxl has an IndexError for an unopened parenthesis
        raise NotComputable("it is not a formula") from error


def references_and_names(formula: str) -> list[str]:
    """Return the texts of all references and defined names in a formula, none if it is malformed."""
    try:
        return [t.value for t in tokenize_formula(formula) if (t.type, t.subtype) == ("OPERAND", "RANGE")]
    except NotComputable:
        return []


def referenced_areas(formula: str) -> list[Reference]:
    """Return the areas that a formula refers to, without those behind defined names."""
    return [area for text in references_and_names(formula) if (area := parse_reference(text)) is not None]


class _ErrorValue(Exception):
    """The value of an operand is an error, and so is the result of the formula."""


class _AreaValues(list):  # type: ignore[type-arg]
    """Values of the cells of an area, row by row, with its number of columns and the position of its first cell."""

    def __init__(self, values: list[Any], columns: int, first: tuple[int, int]) -> None:
        super().__init__(values)
        self.columns, self.first = columns, first


_Term = Callable[[], Any]
"""A part of a formula, computed when called: the branch of an IF that is not taken must not be computed."""


def _refuse_error(value: Any) -> Any:
    """Return `value`; raise `_ErrorValue` if it is a `CellError`."""
    if isinstance(value, CellError):
        raise _ErrorValue(value)
    return value


def _to_scalar(value: Any) -> Any:
    """Return a value as that of one cell; an area of one cell gives its value."""
    if isinstance(value, _AreaValues):
        if len(value) != 1:
            raise NotComputable("it uses a range where one cell belongs")
        value = value[0]
    return _refuse_error(value)


def _to_number(value: Any) -> float:
    """Return a value as a number: 0 for a blank cell; texts are not converted."""
    if (value := _to_scalar(value)) is None:
        return 0.0
    if isinstance(value, (int, float)):
        return float(value)
    if value == "":
        raise _ErrorValue(CellError("#VALUE!"))
    raise NotComputable(f"it refers to {str(value)!r}, not a number")


def _to_text(value: Any) -> str:
    """Return a value as the text that a spreadsheet makes of it for the operator &."""
    value = _to_scalar(value)
    if isinstance(value, bool):
        return str(value).upper()
    if isinstance(value, float):
        if value and not 1e-4 <= abs(value) < 1e15:
            raise NotComputable(f"it makes a text of {value:g}")
        return f"{value:.15g}"
    return "" if value is None else str(value)


def _to_truth(value: Any) -> bool:
    """Return a value as the condition of an IF or the argument of a NOT."""
    value = _to_scalar(value)
    if isinstance(value, str):
        if value.upper() in ("TRUE", "FALSE"):
            return value.upper() == "TRUE"
        raise _ErrorValue(CellError("#VALUE!"))
    return bool(value)


def _evaluate_area(term: _Term) -> _AreaValues:
    """Return the value of a term that must be an area."""
    value = term()
    if not isinstance(value, _AreaValues):
        raise NotComputable("it uses a value where a range belongs")
    return value


def _evaluate_numbers(terms: list[_Term]) -> list[float]:
    """Return the numbers among the cells of areas, and every other argument as a number."""
    numbers = []
    for value in [term() for term in terms]:
        if isinstance(value, _AreaValues):
            numbers += [cell for cell in map(_refuse_error, value) if type(cell) is float]
        else:
            numbers.append(_to_number(value))
    return numbers


def _agree_in_15_digits(a: float, b: float) -> bool:
    """Return whether numbers agree in the 15 digits that spreadsheets show and compare: 0.1 + 0.2 is 0.3."""
    return f"{a:.14e}" == f"{b:.14e}"


def _comparison(compare: Callable[[Any, Any], bool]) -> Callable[[Any, Any], bool]:
    """Return the comparison of two cell values for an operator such as `operator.lt`.

    Numbers are less than texts, texts (in any case) are less than booleans; a blank cell is the zero of the other type.
    """

    def rank(value: Any) -> tuple[int, Any]:
        """Return a key that orders values of all types."""
        if isinstance(value, bool):
            return 2, value
        return (1, value.casefold()) if isinstance(value, str) else (0, value)

    def result(a: Any, b: Any) -> bool:
        """Compare two values as a spreadsheet does."""
        a, b = _to_scalar(a), _to_scalar(b)
        zero = {str: "", bool: False}
        a = zero.get(type(b), 0.0) if a is None else a
        b = zero.get(type(a), 0.0) if b is None else b
        if type(a) is type(b) is float and _agree_in_15_digits(a, b):
            b = a
        return compare(rank(a), rank(b))

    return result


def _number_operator(function: Callable[[float, float], float]) -> Callable[[Any, Any], float]:
    """Return a function of two numbers as a function of any two values."""
    return lambda a, b: function(_to_number(a), _to_number(b))


def _add(a: float, b: float) -> float:
    """Return a + b, exactly 0 where a and -b agree in 15 digits, as spreadsheets do."""
    return 0.0 if _agree_in_15_digits(a, -b) else a + b


def _power(base: float, exponent: float) -> float:
    """Return base^exponent; raise `ValueError` if it is not real."""
    result = base**exponent
    if isinstance(result, complex):
        raise ValueError("no real power")
    return result


_COMPARISONS = {"=": "eq", "<>": "ne", "<": "lt", "<=": "le", ">": "gt", ">=": "ge"}  # names in `operator`
# How tightly each binds, and its function. All group from the left, and a sign in front binds tighter: -2^2 is 4.
_OPERATORS: dict[str, tuple[int, Callable[[Any, Any], Any]]] = {
    **{sign: (0, _comparison(getattr(operator, name))) for sign, name in _COMPARISONS.items()},
    "&": (1, lambda a, b: _to_text(a) + _to_text(b)),
    "+": (2, _number_operator(_add)),
    "-": (2, _number_operator(lambda a, b: _add(a, -b))),
    "*": (3, _number_operator(operator.mul)),
    "/": (3, _number_operator(operator.truediv)),
    "^": (4, _number_operator(_power)),
}


def _atan2(x: float, y: float) -> float:
    """Return the angle of (x, y), rad; x comes first, as in spreadsheets."""
    if x == y == 0:
        raise ZeroDivisionError
    return math.atan2(y, x)


def _rounding_function(rounding: str) -> Callable[[float, float], float]:
    """Return ROUND or a relative of it for a rounding mode of `decimal`."""

    def function(value: float, digits: float) -> float:
        """Round a value to a number of decimals, which may be negative."""
        # Spreadsheets round the decimals that they show, not the binary digits: ROUND(2.675,2) is 2.68.
        step = decimal.Decimal(1).scaleb(-int(digits))
        with decimal.localcontext(prec=400):
            return float(decimal.Decimal(f"{value:.15g}").quantize(step, rounding=rounding))

    return function


def _evaluate_truths(first: _Term, *further: _Term) -> list[bool]:
    """Return the arguments of AND or OR as booleans."""
    values = [_to_scalar(term()) for term in (first, *further)]
    if not all(isinstance(value, (bool, float)) for value in values):
        raise NotComputable("it uses a text or a blank as a truth value")
    return [bool(value) for value in values]


def _if(condition: _Term, then: _Term, otherwise: _Term = lambda: False) -> Any:
    """Return the value of IF; only the chosen branch is computed."""
    return _to_scalar((then if _to_truth(condition()) else otherwise)())


def _if_error(value: _Term, otherwise: _Term) -> Any:
    """Return the value of IFERROR."""
    try:
        return _to_scalar(value())
    except (_ErrorValue, ArithmeticError, ValueError):
        return _to_scalar(otherwise())


def _index(cells: _Term, row: _Term, column: _Term = lambda: None) -> Any:
    """Return the value of INDEX."""
    area, column_value = _evaluate_area(cells), column()
    i, j = int(_to_number(row())), 1 if column_value is None else int(_to_number(column_value))
    if column_value is None and len(area) == area.columns:  # in an area of one row, a single index is the column
        i, j = 1, i
    elif column_value is None and area.columns > 1:
        raise _ErrorValue(CellError("#REF!"))
    if i == 0 or j == 0:
        raise NotComputable("it uses a whole row or column of a range")
    if i < 0 or j < 0 or j > area.columns or i > len(area) // area.columns:
        raise _ErrorValue(CellError("#REF!" if i > 0 and j > 0 else "#VALUE!"))
    return _to_scalar(area[(i - 1) * area.columns + j - 1])


def _find_position(value: Any, cells: list[Any], mode: Any) -> int:
    """Return the index of the first cell that equals `value`; `mode` is the last argument of MATCH or VLOOKUP."""
    value = _to_scalar(value)
    if _to_number(mode) != 0:
        raise NotComputable("it looks up the nearest value")
    if isinstance(value, str) and set(value) & set("*?~"):
        raise NotComputable("it looks for a pattern")
    equal = _comparison(operator.eq)
    for i, cell in enumerate(cells):
        if cell is not None and not isinstance(cell, CellError) and equal(value, cell):
            return i
    raise _ErrorValue(CellError("#N/A"))


def _vlookup(value: _Term, cells: _Term, column: _Term, mode: _Term = lambda: 1.0) -> Any:
    """Return the value of VLOOKUP: the cell in `column`, from 1, of the row whose first cell equals `value`."""
    area, j = _evaluate_area(cells), int(_to_number(column()))
    if not 1 <= j <= area.columns:
        raise _ErrorValue(CellError("#REF!" if j > 0 else "#VALUE!"))
    return _to_scalar(area[_find_position(value(), area[:: area.columns], mode()) * area.columns + j - 1])


_NUMBER_FUNCTIONS: dict[str, Callable[..., float]] = {
    name: getattr(math, name.lower())
    for name in ("ACOS", "ASIN", "ATAN", "COS", "DEGREES", "EXP", "LOG10", "RADIANS", "SIN", "SQRT", "TAN")
} | {
    "ABS": abs,
    "ATAN2": _atan2,
    "INT": math.floor,
    "LN": lambda x: math.log(x),
    "LOG": lambda x, base=10.0: math.log10(x) if base == 10 else math.log(x) / math.log(base),
    "MOD": lambda x, divisor: x - divisor * math.floor(x / divisor),
    "PI": lambda: math.pi,
    "POWER": _power,
    "ROUND": _rounding_function(decimal.ROUND_HALF_UP),
    "ROUNDDOWN": _rounding_function(decimal.ROUND_DOWN),
    "ROUNDUP": _rounding_function(decimal.ROUND_UP),
    "SIGN": lambda x: (x > 0) - (x < 0),
}
"""Spreadsheet functions of numbers."""
_RANGE_FUNCTIONS: dict[str, Callable[[list[float]], float]] = {
    "AVERAGE": lambda xs: math.fsum(xs) / len(xs),
    "MAX": lambda xs: max(xs, default=0.0),
    "MIN": lambda xs: min(xs, default=0.0),
    "PRODUCT": lambda xs: math.prod(xs) if xs else 0.0,
    "SUM": math.fsum,
    "SUMSQ": lambda xs: math.fsum(x * x for x in xs),
}
"""Spreadsheet functions of any number of values and areas, of which they take the numbers."""
_TERM_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "AND": lambda *terms: all(_evaluate_truths(*terms)),
    "COUNT": lambda cells: float(sum(type(cell) is float for cell in _evaluate_area(cells))),
    "COUNTA": lambda cells: float(sum(cell is not None for cell in _evaluate_area(cells))),
    "FALSE": lambda: False,
    "IF": _if,
    "IFERROR": _if_error,
    "INDEX": _index,
    "MATCH": lambda value, cells, mode=lambda: 1.0: _find_position(value(), _evaluate_area(cells), mode()) + 1.0,
    "NOT": lambda term: not _to_truth(term()),
    "OR": lambda *terms: any(_evaluate_truths(*terms)),
    "TRUE": lambda: True,
    "VLOOKUP": _vlookup,
}
"""Spreadsheet functions that evaluate their arguments themselves."""


class FormulaParser:
    """Recursive-descent parser of a formula; each parsing method returns the term for the tokens that it has consumed."""

    def __init__(self, formula: str, context: FormulaContext) -> None:
        self.tokens, self.context, self.index = tokenize_formula(formula), context, 0

    def value(self) -> Any:
        """Parse the whole formula and return its value."""
        term = self.operation(0)
        if self.index < len(self.tokens):
            raise NotComputable(f"it uses {self.tokens[self.index].value!r}")
        return term()

    def is_next(self, kind: str, subtype: str = "") -> bool:
        """Return whether the next token has this type, and this subtype if one is given."""
        token = self.tokens[self.index] if self.index < len(self.tokens) else None
        return token is not None and token.type == kind and subtype in ("", token.subtype)

    def take(self) -> Any:
        """Consume the next token and return it."""
        if self.index == len(self.tokens):
            raise NotComputable("it ends too early")
        self.index += 1
        return self.tokens[self.index - 1]

    def close(self, kind: str) -> None:
        """Consume a closing parenthesis of this type of token."""
        if not self.is_next(kind, "CLOSE"):
            raise NotComputable("a parenthesis is not closed")
        self.take()

    def operation(self, level: int) -> _Term:
        """Parse operands joined by operators that bind as tightly as `level`, or tighter."""
        term = self.signed_operand()
        while self.is_next("OPERATOR-INFIX") and (sign := self.tokens[self.index].value) in _OPERATORS:
            binding, function = _OPERATORS[sign]
            if binding < level:
                break
            self.take()
            term = _apply(function, term, self.operation(binding + 1))
        return term

    def signed_operand(self) -> _Term:
        """Parse an operand with the signs in front of it and the % behind it."""
        if self.is_next("OPERATOR-PREFIX"):
            sign = -1.0 if self.take().value == "-" else 1.0
            term = self.signed_operand()
            return lambda: sign * _to_number(term())
        term = self.operand()
        while self.is_next("OPERATOR-POSTFIX"):
            self.take()
            term = _apply(_number_operator(operator.truediv), term, lambda: 100.0)
        return term

    def operand(self) -> _Term:
        """Parse a parenthesis, a function call, a reference or a constant."""
        token = self.take()
        text, kind = token.value, (token.type, token.subtype)
        if kind == ("PAREN", "OPEN"):
            term = self.operation(0)
            self.close("PAREN")
            return term
        if kind == ("FUNC", "OPEN"):
            return self.call(text[:-1].upper().removeprefix("_XLFN."))
        if kind == ("OPERAND", "RANGE"):
            return lambda: self.read_area(text)
        if kind[0] != "OPERAND":
            raise NotComputable(f"it uses {text!r}")
        if kind[1] == "NUMBER":
            return lambda: float(text)
        if kind[1] == "TEXT":
            return lambda: text[1:-1].replace('""', '"')
        return lambda: text.upper() == "TRUE" if kind[1] == "LOGICAL" else CellError(text)

    def call(self, name: str) -> _Term:
        """Parse the arguments of a function behind its opening parenthesis."""
        terms: list[_Term] = []
        while not self.is_next("FUNC", "CLOSE"):
            is_empty = self.is_next("SEP")  # as the second argument of IF(A1,,2)
            terms.append((lambda: None) if is_empty else self.operation(0))
            if not self.is_next("SEP"):
                break
            self.take()
        self.close("FUNC")
        return lambda: self.evaluate_call(name, terms)

    def evaluate_call(self, name: str, terms: list[_Term]) -> Any:
        """Return the value of a function of these arguments."""
        if name in ("ROW", "COLUMN") and len(terms) < 2:
            position = _evaluate_area(terms[0]).first if terms else self.context.position
            if position is not None:
                return float(position[name == "COLUMN"])
        if name in _RANGE_FUNCTIONS:
            return float(_RANGE_FUNCTIONS[name](_evaluate_numbers(terms)))
        try:
            if name in _NUMBER_FUNCTIONS:
                return float(_NUMBER_FUNCTIONS[name](*(_to_number(term()) for term in terms)))
            if name in _TERM_FUNCTIONS:
                return _TERM_FUNCTIONS[name](*terms)
        except TypeError as error:
            raise NotComputable(f"it uses {name} with {len(terms)} arguments") from error
        raise NotComputable(f"it uses the function {name}")

    def read_area(self, text: str) -> Any:
        """Return the values of the cells that a reference names, or the value behind a defined name."""
        if (area := parse_reference(text)) is None:
            if (formula := self.context.name(text)) is None:
                raise NotComputable(f"it uses {text}")
            return FormulaParser(formula, self.context).value()
        sheet, top, left, bottom, right = area
        if sheet is not None and ":" in sheet:
            raise NotComputable(f"it uses {text}, through several sheets")
        if self.context.extent and area.size > _MAX_RANGE:
            last_row, last_column = self.context.extent(sheet)  # all cells beyond these are blank
            bottom, right = max(top, min(bottom, last_row)), max(left, min(right, last_column))
        if (bottom - top + 1) * (right - left + 1) > _MAX_RANGE:
            raise NotComputable(f"it uses the large range {text}")
        rows, columns = range(top, bottom + 1), range(left, right + 1)
        values = [self.context.lookup(sheet, row, column) for row in rows for column in columns]
        return _AreaValues(values, len(columns), (top, left))


def _apply(function: Callable[[Any, Any], Any], a: _Term, b: _Term) -> _Term:
    """Return the term that applies a function to the values of two terms."""
    return lambda: function(a(), b())
