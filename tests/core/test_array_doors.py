"""Wherever counts, images and volumes come in, masked, complex and infinite numbers are refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import h5py
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.runs.mosaic import as_seen

from .conftest import emission, refused

GRID = mph.Grid.centered((3, 4, 5), 12.0)
PIXELS = (4, 6)
_TURN = np.linspace(0.1, 5.0, 4)
SYSTEM = mph.PinholeSystem(
    np.stack([220 * np.cos(_TURN), 200 * np.sin(_TURN), 10 * _TURN], axis=1), 2.0, 60.0, 50.0, 9.0, 75.0
)


def doors() -> dict[str, tuple[tuple[int, ...], Callable[[Any], object]]]:
    """Return everything that takes an array of the user's: the array's shape, and the call."""
    views = SYSTEM.views(PIXELS, "real")
    images, voxels = (len(SYSTEM), *PIXELS), GRID.shape
    A = mph.Projector(GRID, views, emission(SYSTEM, mu=mph.Volume(np.zeros(voxels), GRID, "mu")))
    rays = mph.Projector(GRID, views)
    truth = np.random.default_rng(1).uniform(1, 2, voxels)
    around = mph.parallel_views(np.arange(4) * 0.7, PIXELS, 9.0)
    ones, counts = np.ones(voxels), np.ones(images)
    g = mph.PerspectiveGrid(views, 0, 3, 150.0, 300.0)
    return {
        "Volume": (voxels, lambda x: mph.Volume(x, GRID)),
        "ProjectionRun": (images, lambda x: mph.ProjectionRun(x, SYSTEM, views, unit="counts")),
        "counts_run": (images, lambda x: mph.counts_run(x, SYSTEM, "1-4", "back-v", 3.0, expected=True)),
        "Projector": (voxels, A),
        "Projector of mu": (voxels, lambda x: A(ones, mu=x)),
        "adjoint": (images, A.T),
        "intensity": (images, lambda x: mph.intensity(x, 1e3)),
        "trace_rays": (voxels, lambda x: mph.trace_rays(x, [[0, 0, -99]], [[0, 0, 99]], grid=GRID)),
        "sample_counts": (images, lambda x: mph.sample_counts(x, 1)),
        "background": (images, lambda x: mph.Emission(SYSTEM, background=x)),
        "mlem": (images, lambda x: mph.mlem(A, x, 1)),
        "osem": (images, lambda x: mph.osem(A, x, 1)),
        "bsrem": (images, lambda x: mph.bsrem(A, x, 1)),
        "sirt": (images, lambda x: mph.sirt(A, x, 1)),
        "cgls": (images, lambda x: mph.cgls(A, x, 1)),
        "tv": (images, lambda x: mph.tv(rays, x, 0.1, 1)),
        "background of mlem": (images, lambda x: mph.mlem(A, counts, 1, background=x)),
        "start": (voxels, lambda x: mph.mlem(A, counts, 1, start=x)),
        "fbp": ((4, *PIXELS), lambda x: mph.fbp(x, around, GRID)),
        "backproject": (images, lambda x: mph.backproject(x, views, GRID)),
        "from_perspective": (g.shape, lambda x: mph.from_perspective(x, g, GRID)),
        "nrmse": (voxels, lambda x: mph.nrmse(x, truth)),
        "contrast_to_noise": (voxels, lambda x: mph.contrast_to_noise(x, ones > 0, ones > 0)),
    }


DOORS = doors()


@pytest.mark.parametrize("name", DOORS)
def test_numbers_that_are_hidden_complex_or_infinite_are_refused_in_one_line(name):
    shape, call = DOORS[name]
    good = np.random.default_rng(2).uniform(1, 9, shape)
    call(good), call(np.ma.array(good))  # that nothing is hidden
    hidden = np.zeros(shape, bool)
    hidden[(1,) * len(shape)] = hidden[(0,) * len(shape)] = True
    for kind in (np.float64, np.float32, np.int64):
        masked = np.ma.array(good.astype(kind), mask=hidden)
        refused(lambda masked=masked: call(masked), f"2 of {good.size} numbers are masked")
    frozen = np.ma.array(good.astype(np.float32), mask=True)
    frozen.flags.writeable = False
    refused(lambda: call(frozen), f"{good.size} of {good.size} numbers are masked")
    refused(lambda: call(list(np.ma.array(good, mask=hidden))), f"2 of {good.size} numbers are masked")
    refused(lambda: call(good + 0j))
    for wrong, said in ((np.nan, "nan is not a finite number"), (-np.inf, "-inf is not a finite number")):
        for kind in (np.float64, np.float32):
            bad = good.astype(kind)
            bad[(1,) * len(shape)] = wrong
            refused(lambda bad=bad: call(bad), said, str((1,) * len(shape)))


@pytest.mark.parametrize("name", sorted(set(DOORS) - {"nrmse", "contrast_to_noise", "sample_counts", "intensity"}))
def test_numbers_beyond_single_precision_are_refused_by_their_own_value(name):
    shape, call = DOORS[name]
    large = np.ones(shape)
    large[(1,) * len(shape)] = 3e39
    refused(lambda: call(large), "3e+39")


def test_masks_labels_and_pictures_are_refused_too():
    voxels = np.ones(GRID.shape)
    hidden = np.ma.array(voxels > 0, mask=voxels > 0)
    A = mph.Projector(GRID, SYSTEM.views(PIXELS), emission(SYSTEM))
    for call in (
        lambda: mph.mlem(A, np.ones(A.shape_out), 1, mask=hidden),
        lambda: mph.StopWhen(noise=0.1, region=hidden),
        lambda: mph.nrmse(voxels, voxels, mask=hidden),
        lambda: mph.split_labels(mph.Volume(voxels, GRID, "hu"), np.ma.array(voxels, mask=True)),
        lambda: as_seen(np.ma.array(np.ones((2, 3, 4)), mask=True)),
        lambda: mph.counts_run([np.ma.array(np.ones(PIXELS, int), mask=True)] * 4, SYSTEM, "1-4", "back-v", 3.0),
    ):
        refused(call, "masked")


@pytest.mark.parametrize(
    ("value", "said", "what"),
    [
        (np.nan, "nan", "projections"),
        (1e300, "1e+300", "volume/array"),
        (-np.inf, "-inf", "background"),
        (2 + 1j, "complex128", "projections"),
    ],
)
def test_runs_that_hold_no_numbers_are_refused(value, said, what, tmp_path):
    volume = mph.Volume(np.ones(GRID.shape), GRID)
    views = SYSTEM.views(PIXELS)
    run = mph.ProjectionRun(np.ones((4, *PIXELS)), SYSTEM, views, volume, background=np.ones((4, *PIXELS)))
    mph.write_run(run, tmp_path / "run.h5")
    with h5py.File(tmp_path / "run.h5", "r+") as file:
        numbers = file[what][()].astype(np.result_type(np.float64, np.asarray(value)))
        numbers[2, 3, 4] = value
        del file[what]
        file[what] = numbers
    with open(tmp_path / "run.h5", "r+b") as file:
        file.write(bytes(512))  # without its seal, which says that something was changed
    refused(lambda: mph.read_run(tmp_path / "run.h5"), "run.h5", said if said != "complex128" else "real numbers")
    for kind in (np.float32, np.float64):
        images = np.ones((4, *PIXELS), kind)
        with np.errstate(over="ignore"):
            images[2, 3, 4] = abs(value)
        if not np.isfinite(images).all() or images.max() > 1e38:
            refused(lambda images=images: mph.ProjectionRun(images, SYSTEM, views, unit="counts"), "(2, 3, 4)")
