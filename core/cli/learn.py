"""Command ``mphdrr learn new|train|judge``: networks that reconstruct, trained on event sets and judged on others."""

import argparse

from .. import learning
from ..errors import InputError
from ..learning.networks import NETWORKS
from .options import add_actions, add_run, output_path, print_or_write_recipe, progress_bar, say


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command ``mphdrr learn`` with its actions."""
    example = "mphdrr learn new -o training.toml\nexample: mphdrr learn train training.toml -o model.pt"
    actions = add_actions(subparsers, "learn", example)
    new = add_run(actions, "new", _new)
    names = "\n".join(f"  {name:<13}{kind.label}: {kind.text}" for name, kind in NETWORKS.items())
    new.epilog = f"networks:\n{names}\n{new.epilog}"
    new.add_argument("--like", choices=tuple(NETWORKS), default="after-osem", metavar="NAME", help="one of those below")
    new.add_argument("-o", "--output", metavar="FILE", help="a new file (.toml); default: standard output")
    train = add_run(actions, "train", _train)
    train.add_argument("recipe", metavar="RECIPE", help="recipe of the training (.toml)")
    text = "the model file (.pt); samples and checkpoints are kept beside it"
    train.add_argument("-o", "--output", metavar="MODEL", required=True, help=text)
    train.add_argument("--workers", type=int, default=1, metavar="N", help="processes that prepare samples")
    judge = add_run(actions, "judge", _judge)
    judge.add_argument("recipe", metavar="RECIPE", help="recipe of the judge (.toml): tests, baselines and models")
    text = "folder for the table, the picture and the scores, which are kept to resume"
    judge.add_argument("-o", "--output", metavar="FOLDER", required=True, help=text)
    judge.add_argument("--into-models", action="store_true", help="also write its rows into each model's file")
    for action in (train, judge):
        action.add_argument("--quiet", action="store_true", help="say nothing on standard error but warnings")


def _new(arguments: argparse.Namespace) -> None:
    """Write a commented training recipe to start from.

    mphdrr learn new --like unrolled -o training.toml
    """
    from ..learning.recipe import template_text

    print_or_write_recipe(template_text(arguments.like), arguments.output, "mphdrr learn train {path} -o model.pt")


def _train(arguments: argparse.Namespace) -> None:
    """Train a network by a recipe and write its model file; the same command resumes an interrupted training.

    mphdrr learn train training.toml -o model.pt
    mphdrr reconstruct run.h5 --method model.pt -o volume.nii.gz
    """
    if arguments.workers < 1:
        raise InputError(f"--workers: expected 1 or more, got {arguments.workers}")
    path = output_path(arguments.output, (".pt",))
    recipe = learning.read_recipe(arguments.recipe)
    try:
        model = learning.train(recipe, path, arguments.workers, progress_bar)
    except KeyboardInterrupt:
        say(f"{path}: samples and the last checkpoint are kept; the same command goes on")
        raise
    end = model.contents.curve[-1]
    print(f"{path}: {model.label}, {end['step']} steps, NRMSE {end['validation']:.3f} of the validation")


def _judge(arguments: argparse.Namespace) -> None:
    """Judge models beside tuned baselines: one table and one picture; the same command resumes an interrupted judgement.

    mphdrr learn judge judge.toml -o judgement
    """
    recipe = learning.read_judge_recipe(arguments.recipe)
    models = {name: learning.read_model(path) for name, path in recipe.models.items()}
    methods = [model.judged(name) for name, model in models.items()]
    judgement = learning.judge(recipe, arguments.output, methods, progress_bar("judging"))
    for name, model in models.items() if arguments.into_models else ():
        rows = [row for row in judgement.rows if row["method"] == name]
        learning.with_judgement(model.path, {**judgement.record, "rows": rows})
    print(f"{arguments.output}: {len(judgement.rows)} rows in judgement.md, .json and .png")
