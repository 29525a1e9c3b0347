"""Which formulas of a workbook depend on which cells."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable

import numpy as np

from .formulas import NotComputable, tokens_of
from .references import reference
from .workbook_xml import Place, WorkbookXml

_AT_ONCE = 64
"""Cells of an area that are noted one by one; of larger ones, the corners."""
_NAMES_DEEP = 20
_UNFORESEEABLE = {"INDIRECT", "OFFSET"}

_OTHER_FILE = re.compile(r"'?[^!]*\[[^\]]+\][^!]*'?!")

_Area = tuple[str, int, int, int, int]


class Unforeseeable(Exception):
    """What a formula refers to is not written in it."""


class Dependencies:
    """The formulas of `workbook` as they are now, and the cells that each names."""

    def __init__(self, workbook: WorkbookXml) -> None:
        self._workbook = workbook
        self._of_cell: dict[Place, list[Place]] = defaultdict(list)
        self.formulas: set[Place] = set()
        self.unforeseeable: set[Place] = set()
        large: dict[str, list[tuple[Place, tuple[int, int, int, int]]]] = defaultdict(list)
        arrays: dict[tuple[str, object], list[_Area]] = {}
        for title, sheet in workbook.sheets.items():
            for at, cell in sheet.cells.items():
                place = (title, *at)
                if cell.formula is None and cell.array is None:
                    continue
                self.formulas.add(place)
                if cell.formula is None:
                    continue
                try:
                    areas = self._areas(cell.formula, place)
                except (Unforeseeable, NotComputable):
                    self.unforeseeable.add(place)
                    areas = []
                if cell.array is not None:
                    arrays[title, cell.array] = areas
                self._note(place, areas, large)
        for title, sheet in workbook.sheets.items():
            for at, cell in sheet.cells.items():
                if cell.array is not None and cell.formula is None:
                    self._note((title, *at), arrays.get((title, cell.array), []), large)
                    master = (title, cell.array.top, cell.array.left)
                    if master in self.unforeseeable or (title, cell.array) not in arrays:
                        self.unforeseeable.add((title, *at))
        self._large = {
            title: ([place for place, _ in found], np.array([area for _, area in found]))
            for title, found in large.items()
        }

    def _note(
        self, place: Place, areas: Iterable[_Area], large: dict[str, list[tuple[Place, tuple[int, int, int, int]]]]
    ) -> None:
        for title, top, left, bottom, right in areas:
            if (bottom - top + 1) * (right - left + 1) > _AT_ONCE:
                large[title].append((place, (top, left, bottom, right)))
                continue
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    self._of_cell[title, row, column].append(place)

    def _areas(self, formula: str, place: Place, depth: int = 0) -> list[_Area]:
        found: list[_Area] = []
        for token in tokens_of(formula):
            if token.type == "FUNC" and token.subtype == "OPEN":
                name = token.value[:-1].upper()
                if name in _UNFORESEEABLE or ":" in name:
                    raise Unforeseeable(name)
            if token.type != "OPERAND" or token.subtype != "RANGE":
                continue
            area = reference(token.value)
            if area is not None:
                sheets = [place[0]] if area.sheet is None else self._workbook.between(area.sheet)
                found += [(sheet, area.top, area.left, area.bottom, area.right) for sheet in sheets]
            elif _OTHER_FILE.match(token.value):
                continue  # another file's cell does not change with this one's
            else:
                meaning = self._workbook.meaning(place, token.value)
                if meaning is None or depth == _NAMES_DEEP:
                    raise Unforeseeable(token.value)
                found += self._areas(meaning, place, depth + 1)
        return found

    def of(self, place: Place) -> set[Place]:
        """The formulas that name the cell."""
        found = set(self._of_cell.get(place, ()))
        title, row, column = place
        if title in self._large:
            places, areas = self._large[title]
            inside = (areas[:, 0] <= row) & (row <= areas[:, 2]) & (areas[:, 1] <= column) & (column <= areas[:, 3])
            found.update(places[i] for i in np.flatnonzero(inside))
        return found

    def affected(self, changed: Iterable[Place]) -> set[Place]:
        """The formulas that depend on `changed`, however far, or may do so; those of `changed` are among them."""
        changed = set(changed)
        found = (changed & self.formulas) | self.unforeseeable
        waiting = list(changed | self.unforeseeable)
        while waiting:
            new = self.of(waiting.pop()) - found
            found |= new
            waiting += new
        return found

    def in_order(self, places: Iterable[Place]) -> tuple[list[Place], list[Place]]:
        """`places` with those that others need before these; and the rest: in a circle, or in need of such."""
        places = set(places)
        ordered = _sorted(self._needed_by(places))
        return ordered, sorted(places.difference(ordered))

    def circular(self, rest: Iterable[Place]) -> list[Place]:
        """Those of the rest that need themselves, at once or through others."""
        needed_by = self._needed_by(set(rest))
        needs: dict[Place, set[Place]] = {place: set() for place in needed_by}
        for place, dependents in needed_by.items():
            for dependent in dependents:
                needs[dependent].add(place)
        return sorted(set(needs).difference(_sorted(needs)))

    def _needed_by(self, places: set[Place]) -> dict[Place, set[Place]]:
        return {place: self.of(place) & places for place in places}


def _sorted(followers: dict[Place, set[Place]]) -> list[Place]:
    """Each place before its followers; those left out that never can be."""
    missing = dict.fromkeys(followers, 0)
    for places in followers.values():
        for place in places:
            missing[place] += 1
    ready = sorted((place for place in followers if not missing[place]), reverse=True)
    ordered = []
    while ready:
        place = ready.pop()
        ordered.append(place)
        for follower in followers[place]:
            missing[follower] -= 1
            if not missing[follower]:
                ready.append(follower)
    return ordered
