"""From single events' scores to the rows of the judge's table."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...errors import InputError
from .observer import observe
from .rods import PRESENT
from .statistics import difference_of_means, ratio_of_means, wilson

Rows = Sequence[Mapping[str, Any]]

ENOUGH_EVENTS, ENOUGH_SITES = 50, 200
"""Of which intervals mean what they say; of fewer the table tells."""
_MEANS = ("nrmse", "ssim", "contrast", "deviance", "seconds")
_DRAWN = ("bias", "deviation")


def means_of(rows: Rows, drawn: Rows = ()) -> dict[str, Any]:
    """What one method's scores say by themselves: means, shares with Wilson's intervals, the observer's AUC."""
    found: dict[str, Any] = {"events": len(rows)}
    for names, source in ((_MEANS, rows), (_DRAWN, drawn)):
        for name in names:
            values = [row[name] for row in source if name in row]
            if values:
                found[name] = float(np.mean(values))
    found["megabytes"] = max(row["megabytes"] for row in rows)
    if any("rods" in row for row in rows):
        found["sensitivity"] = wilson(sum(row["rods_seen"] for row in rows), sum(row["rods"] for row in rows))
    with_rod, without = ([row for row in rows if row.get("site_has_rod") is has] for has in (True, False))
    if with_rod:
        found["sensitivity"] = wilson(sum(row["site"] > PRESENT for row in with_rod), len(with_rod))
    if without:
        found["false_rods"] = wilson(sum(row["site"] > PRESENT for row in without), len(without))
    if with_rod or without:
        found["sites"] = len(with_rod) + len(without)
    absent, present = ([row["channels"] for row in rows if row.get("defect") is has] for has in (False, True))
    if absent and present:
        try:
            observed = observe(absent, present)
        except InputError as error:
            found["note"] = str(error)
        else:
            found |= {"auc": observed.auc, "snr": observed.snr}
    return found


def compared(rows: Rows, others: Rows, seed: int) -> dict[str, Any]:
    """How a method does beside another on the same events, in the same order: paired bootstrap intervals."""
    own, other = (np.array([row["nrmse"] for row in each]) for each in (rows, others))
    found: dict[str, Any] = {"ratio": ratio_of_means(own, other, seed)}
    own, other = (
        np.array([float(row["site"] > PRESENT) for row in each if row.get("site_has_rod") is False])
        for each in (rows, others)
    )
    if len(own):
        found["false_rods_more"] = difference_of_means(own, other, seed)
    return found


def told_of(row: Mapping[str, Any]) -> list[str]:
    """What weakens a row of the table."""
    notes = [row["note"]] if "note" in row else []
    if row["events"] < ENOUGH_EVENTS:
        notes.append(f"{row['events']} events, fewer than {ENOUGH_EVENTS}")
    if row.get("sites", ENOUGH_SITES) < ENOUGH_SITES:
        notes.append(f"{row['sites']} altered sites, fewer than {ENOUGH_SITES}")
    return notes
