"""Summary of single events' scores in the rows of the judge's table."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...errors import InputError
from ...reconstruction.scores.summary import JUDGED_SCORES
from .observer import observe
from .rods import PRESENT
from .statistics import difference_of_means, ratio_of_means, wilson

Rows = Sequence[Mapping[str, Any]]

ENOUGH_EVENTS, ENOUGH_SITES = 50, 200
"""Numbers of events and of sites from which on intervals are reliable; rows with fewer get a note."""
_MEANS = ("nrmse", *(row.name for row in JUDGED_SCORES), "contrast", "deviance", "seconds")
_DRAWN = ("bias", "deviation")


def mean_scores(rows: Rows, drawn: Rows = ()) -> dict[str, Any]:
    """Return the summary of one method's scores: means, proportions with Wilson's intervals, the observer's AUC.

    `drawn` are scores over draws of noise.
    """
    summary: dict[str, Any] = {"events": len(rows)}
    for names, source in ((_MEANS, rows), (_DRAWN, drawn)):
        for name in names:
            if values := [row[name] for row in source if name in row]:
                summary[name] = float(np.mean(values))
    summary["megabytes"] = max(row["megabytes"] for row in rows)
    if any("rods" in row for row in rows):
        summary["sensitivity"] = wilson(sum(row["rods_seen"] for row in rows), sum(row["rods"] for row in rows))
    with_rod, without_rod = ([row for row in rows if row.get("site_has_rod") is has] for has in (True, False))
    if with_rod:
        summary["sensitivity"] = wilson(sum(row["site"] > PRESENT for row in with_rod), len(with_rod))
    if without_rod:
        summary["false_rods"] = wilson(sum(row["site"] > PRESENT for row in without_rod), len(without_rod))
    if with_rod or without_rod:
        summary["sites"] = len(with_rod) + len(without_rod)
    absent, present = ([row["channels"] for row in rows if row.get("defect") is has] for has in (False, True))
    if absent and present:
        try:
            observer = observe(absent, present)
        except InputError as error:
            summary["note"] = str(error)
        else:
            summary |= {"auc": observer.auc, "snr": observer.snr}
    return summary


def compare_scores(rows: Rows, reference_rows: Rows, seed: int) -> dict[str, Any]:
    """Return paired bootstrap intervals of a method's scores relative to those of a reference method.

    `rows` and `reference_rows` are the scores of both methods for the same events in the same order.
    """
    values, references = (np.array([row["nrmse"] for row in method_rows]) for method_rows in (rows, reference_rows))
    comparison: dict[str, Any] = {"ratio": ratio_of_means(values, references, seed)}
    values, references = (
        np.array([float(row["site"] > PRESENT) for row in method_rows if row.get("site_has_rod") is False])
        for method_rows in (rows, reference_rows)
    )
    if len(values):
        comparison["false_rods_more"] = difference_of_means(values, references, seed)
    return comparison


def row_notes(row: Mapping[str, Any]) -> list[str]:
    """Return notes on the weaknesses of a row of the table."""
    notes = [row["note"]] if "note" in row else []
    if row["events"] < ENOUGH_EVENTS:
        notes.append(f"{row['events']} events, fewer than {ENOUGH_EVENTS}")
    if row.get("sites", ENOUGH_SITES) < ENOUGH_SITES:
        notes.append(f"{row['sites']} altered sites, fewer than {ENOUGH_SITES}")
    return notes
