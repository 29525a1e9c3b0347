"""Command ``mphdrr backproject RUN -o volume.nii.gz``: sum, geometric mean or minimum of a run's views at each voxel."""

import argparse

from ... import core as mph
from ..perspective.backprojection import HOW
from ..runs import FORMATS
from ..runs.settings import SETTINGS
from ..volumes.volume_files import VOLUME_FORMATS
from .options import add_run, describe_volume, output_path, print_answer, progress_bar
from .recipe_options import add_setting, entries_from_options


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command ``mphdrr backproject``."""
    parser = add_run(subparsers, "backproject", _run)
    parser.add_argument("file", metavar="RUN", help=f"a run of mphDRR: {', '.join(FORMATS)}")
    text = "over the views that see a voxel: the sum of their values, their geometric mean, or the smallest"
    parser.add_argument("--how", choices=tuple(HOW), default="sum", help=text)
    for name in ("voxels", "spacing", "center"):
        add_setting(parser, SETTINGS[f"reconstruction.{name}"])
    add = parser.add_argument
    add("-o", "--output", required=True, metavar="FILE", help=f"the volume: {', '.join(VOLUME_FORMATS)}")
    add("--views-that-see", metavar="FILE", help="also write how many views see each voxel, as a volume")
    add("--json", action="store_true", help="print JSON")
    parser.set_defaults(entries=[])


def _run(arguments: argparse.Namespace) -> None:
    """Combine the values of a run's views at each voxel: sum, geometric mean or minimum.

    mphdrr backproject run.h5 --how product --voxels 128 128 64 --spacing 1 -o product.nii.gz
    """
    from ..runs.backprojecting import backprojection_grid

    path = output_path(arguments.output, VOLUME_FORMATS)
    count_path = output_path(arguments.views_that_see, VOLUME_FORMATS) if arguments.views_that_see else None
    run = mph.read_run(arguments.file)
    grid = backprojection_grid(run, run.recipe.updated(entries_from_options(arguments)))
    view_counts = mph.views_that_see(run.views, grid, progress_bar("counting views"))
    assert isinstance(view_counts, mph.Volume)
    if not view_counts.array.any():
        raise mph.InputError("--center: no view sees any of these voxels; expected some in the field of view")
    volume = mph.backproject_run(run, arguments.how, grid=grid, stages=progress_bar)
    mph.write_volume(volume, path)
    if count_path is not None:
        mph.write_volume(view_counts, count_path)
    fewest, largest = int(view_counts.array.min()), int(view_counts.array.max())
    record = {
        "file": str(path),
        "how": arguments.how,
        "views": len(run.views),
        "voxels": list(grid.shape),
        "spacing_mm": grid.spacing.tolist(),
        "smallest": float(volume.array.min()),
        "largest": float(volume.array.max()),
        "fewest_views": fewest,
        "most_views": largest,
    }
    seen_by = f"each seen by {fewest} to {largest} of {len(run.views)} views"
    print_answer(arguments, record, [f"{path}: {arguments.how}, {describe_volume(volume)}, {seen_by}"])
