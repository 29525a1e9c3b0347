"""The example that comes with mphDRR: a workbook, and how its phantom is turned."""

from pathlib import Path

EXAMPLE = Path(__file__).parents[1] / "examples" / "dc-spect-80.xlsx"
EULER_DEGREES = (30.0, 55.0, 0.0)  # tilted, so that modules see along and across the rods
