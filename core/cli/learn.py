"""``mphdrr learn new|train``: networks that reconstruct, trained on event sets."""

import argparse
from pathlib import Path

from .. import learning
from ..errors import InputError
from ..files import replacing
from ..learning.networks import NETWORKS
from ..learning.recipe import template_text
from ..progress import Progress
from .options import add_command, add_run, output_path, progress_bar, say


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    example = "mphdrr learn new -o training.toml\nexample: mphdrr learn train training.toml -o model.pt"
    parser = add_command(subparsers, "learn", "train networks that reconstruct", example)
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    new = add_run(actions, "new", _new)
    names = "\n".join(f"  {name:<13}{kind.label}: {kind.text}" for name, kind in NETWORKS.items())
    new.epilog = f"networks:\n{names}\n{new.epilog}"
    text = "network to begin with; see the list below"
    new.add_argument("--like", choices=tuple(NETWORKS), default="after-osem", metavar="NAME", help=text)
    new.add_argument("-o", "--output", metavar="FILE", help="a new file (.toml); default: standard output")
    train = add_run(actions, "train", _train)
    train.add_argument("recipe", metavar="RECIPE", help="recipe of the training (.toml)")
    text = "the model file (.pt); samples and checkpoints are kept beside it"
    train.add_argument("-o", "--output", metavar="MODEL", required=True, help=text)
    train.add_argument("--workers", type=int, default=1, metavar="N", help="processes that prepare samples")
    train.add_argument("--quiet", action="store_true", help="say nothing on standard error but warnings")


def _new(arguments: argparse.Namespace) -> None:
    """Write a commented recipe of a training to begin with.

    mphdrr learn new --like unrolled -o training.toml
    """
    text = template_text(arguments.like)
    if arguments.output is None:
        print(text, end="")
        return
    path = output_path(arguments.output, (".toml",))
    if path.exists():  # recipes are edited by hand
        raise InputError(f"{path}: it exists; choose another name, or remove it first")
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(f"{path}: edit it, then: mphdrr learn train {path} -o model.pt")


def _train(arguments: argparse.Namespace) -> None:
    """Train a network by a recipe and write its model file; the same command goes on with what was interrupted.

    mphdrr learn train training.toml -o model.pt mphdrr reconstruct run.h5 --method model.pt -o volume.nii.gz
    """
    if arguments.workers < 1:
        raise InputError(f"--workers: expected 1 or more, got {arguments.workers}")
    path = output_path(arguments.output, (".pt",))
    recipe = learning.read_recipe(arguments.recipe)
    try:
        model = learning.train(recipe, path, arguments.workers, lambda words: _stage(words, arguments.quiet))
    except KeyboardInterrupt:
        say(f"{path}: samples and the last checkpoint are kept; the same command goes on")
        raise
    last = model.contents.curve[-1]
    print(f"{path}: {model.label}, {last['step']} steps, NRMSE {last['validation']:.3f} of the validation")


def _stage(words: str, is_quiet: bool) -> Progress | None:
    return None if is_quiet else progress_bar(words)
