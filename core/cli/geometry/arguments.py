"""Arguments that the actions share."""

from __future__ import annotations

import argparse


def add_workbook(parser: argparse.ArgumentParser) -> None:
    """The workbook to read, and how to print the answer."""
    parser.add_argument("file", metavar="FILE", help="geometry workbook (.xlsx, .xlsm)")
    parser.add_argument("--json", action="store_true", help="print JSON")
