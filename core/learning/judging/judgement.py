"""What the judge has found."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from ...volumes.volume import Volume

BASELINE, ORACLE, METHOD = "baseline", "tuned on the set", "method"
"""Kinds of rows."""


@dataclass(frozen=True, eq=False)
class Judgement:
    """What the judge has found."""

    rows: list[dict[str, Any]]
    """One for each test, level and method."""
    tests: dict[str, dict[str, Any]]
    """By name: the set's hash, its number of events, scoring, what methods are told."""
    tuning: dict[str, Any]
    """What was chosen of each family of baselines, for each level."""
    pictures: list[tuple[str, list[tuple[str, Volume]]]] = field(default_factory=list)
    """Of the first event of some tests: a title, and volumes by name, the truth first."""

    @property
    def record(self) -> dict[str, Any]:
        """All but the pictures, as JSON holds it; intervals are lists of value, low and high."""
        return {"version": 1, "tests": self.tests, "tuning": self.tuning, "rows": self.rows}
