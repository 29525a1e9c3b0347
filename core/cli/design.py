"""Command ``mphdrr design new|optimize|pareto``: design of scanners by gradient-based optimisation."""

import argparse

from ... import core as mph
from ..files import read_text
from .options import add_actions, add_run, output_path, print_answer, print_or_write_recipe, progress_bar, say


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command ``mphdrr design`` with its actions."""
    example = "mphdrr design new -o design.toml\nexample: mphdrr design optimize design.toml -o new.xlsx"
    actions = add_actions(subparsers, "design", example)
    new = add_run(actions, "new", _new)
    new.add_argument("-o", "--output", metavar="FILE", help="a new file (.toml); default: standard output")
    for name, run, ending in (("optimize", _optimize, "the scanner (.xlsx)"), ("pareto", _pareto, "table and plot")):
        action = add_run(actions, name, run)
        action.add_argument("recipe", metavar="RECIPE", help="recipe of the design (.toml)")
        nargs = {"nargs": "+"} if run is _pareto else {}
        action.add_argument("-o", "--output", metavar="FILE", required=True, help=ending, **nargs)  # type: ignore[arg-type]
        action.add_argument("--json", action="store_true", help="print the result as JSON")
        action.add_argument("--quiet", action="store_true", help="show no progress")
    text = "also evaluate the gain by reconstructions, as the recipe's [evaluation] says"
    actions.choices["optimize"].add_argument("--evaluate", action="store_true", help=text)


def _new(arguments: argparse.Namespace) -> None:
    """Write a commented design recipe to start from.

    mphdrr design new -o design.toml
    """
    from ..design.recipe import TEMPLATE

    print_or_write_recipe(read_text(TEMPLATE), arguments.output, "mphdrr design optimize {path} -o scanner.xlsx")


def _optimize(arguments: argparse.Namespace) -> None:
    """Find the scanner that a recipe describes and write its workbook; the same command resumes an interrupted search.

    mphdrr design optimize design.toml -o new.xlsx
    """
    path = output_path(arguments.output, (".xlsx",))
    recipe, state = mph.design.read_design_recipe(arguments.recipe), path.with_suffix(".design.json")
    try:
        result = mph.design.optimize(recipe, progress_bar("designing"), state)
    except KeyboardInterrupt:
        say(f"{state}: the search so far is kept; the same command resumes it")
        raise
    mph.write_system(result.system, path)
    record = {"parameters": result.parameters, "objectives": result.values, "faults": result.faults}
    *lines, verdict = result.summary()
    if arguments.evaluate:
        gain = mph.design.evaluate(recipe, result.start, result.system, progress_bar("evaluating"))
        record["evaluation"] = gain._asdict()
        lines.append(f"{gain.score}: {gain.start:.4g} at the start, now {gain.found:.4g}; better by {gain.gain:.1%}, "
                     f"95 % interval {gain.low:.1%} to {gain.high:.1%}")  # fmt: skip
    print_answer(arguments, record, [*lines, f"{path}: {verdict}"], result.faults)


def _pareto(arguments: argparse.Namespace) -> None:
    """Find a scanner for each value of an entry of the recipe: a table (.csv, .json), a plot (.png, .svg), or both.

    mphdrr design pareto front.toml -o front.csv front.png
    """
    paths = [output_path(name, (".csv", ".json", ".png", ".svg")) for name in arguments.output]
    front = mph.design.pareto(arguments.recipe, progress_bar("designing"))
    for path in paths:
        front.write(path)
    lines = ["  ".join(f"{name} {value:.5g}" for name, value in row.items()) for row in front.rows]
    print_answer(arguments, list(front.rows), lines)
