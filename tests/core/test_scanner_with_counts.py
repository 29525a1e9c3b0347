"""A third kind of scanner whose images are counts, a gamma camera with parallel holes, costs its classes and two rows."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.geometry.columns import Column, ColumnTable
from mphdrr.core.geometry.scanner import SCANNERS, Scanner
from mphdrr.core.models.model import Model
from mphdrr.core.rays.bundles import Beam
from mphdrr.core.rays.ray_geometry import view_rays
from mphdrr.core.runs import model_kinds

SHARE = 1e-4
"""Detected share of the photons from everywhere in front of a head."""


@dataclass(frozen=True, eq=False)
class ParallelHoles(Scanner):
    kind: ClassVar[str] = "toy parallel-hole"
    sheet: ClassVar[str] = "Heads"
    columns: ClassVar[ColumnTable] = ColumnTable(
        [Column("angle", "angles", kind="angle", headings=("angle",), place="Heads!B")]
    )

    angles: Any
    numbers: Any = None
    source: Any = None
    more: Mapping[str, Any] = field(default_factory=dict)

    def poses(self):
        zero, cos, sin = 0 * self.angles, np.cos(self.angles), np.sin(self.angles)
        poses = np.tile(np.eye(4), (len(self), 1, 1))
        poses[:, :3] = np.moveaxis(
            [[-sin, zero, cos, 200 * cos], [cos, zero, sin, 200 * sin], [zero, zero + 1, zero, zero]], 2, 0
        )
        return poses

    def attributes_at(self, poses):
        return {"angles": np.arctan2(poses[:, 1, 3], poses[:, 0, 3])}

    def views(self, shape=(32, 32), detector="real", magnification=1.0, pitch=None, offset=(0.0, 0.0)):
        parallel = mph.parallel_views(self.angles, shape, 5.0 if pitch is None else pitch)
        away = parallel.sources - parallel.detector_centers
        sources = (
            parallel.detector_centers + 1e6 * away / np.linalg.norm(away, axis=1)[:, None]
        )  # runs take no parallel views
        return mph.Views(sources, parallel.detector_centers, parallel.u_steps, parallel.v_steps, shape)


@dataclass(frozen=True, eq=False)
class ParallelHoleCounts(Model):
    system: ParallelHoles
    time: float = 1.0
    start: float = 0.0
    background: float = 0.0
    efficiency: float = 1.0

    name, takes, has_times, ends_at_detector = "parallel-hole emission", ("activity",), True, False

    @property
    def effective_time(self):
        return self.time

    def unit(self, volume):
        return "counts"

    def of_views(self, indices):
        return replace(self, system=self.system[indices])

    def beams(self, views, m, grid):
        pixel = np.linalg.norm(views.u_steps[m]) * np.linalg.norm(views.v_steps[m])
        weight = np.full((1, 1, 1), self.time * SHARE * pixel)
        yield Beam(view_rays(views, m, grid), lambda rows, columns, shifts: weight)


@pytest.fixture
def head(monkeypatch):
    monkeypatch.setitem(SCANNERS, ParallelHoles.kind, ParallelHoles)
    monkeypatch.setattr(
        model_kinds, "COUNT_MODELS", {**model_kinds.COUNT_MODELS, ParallelHoles.kind: ParallelHoleCounts}
    )
    return ParallelHoles(np.linspace(0, np.pi, 12, endpoint=False))


def test_counts_are_simulated_kept_and_reconstructed(head, tmp_path):
    array = np.zeros((24, 24, 24), np.float32)
    array[8:14, 10:15, 9:16] = 2.0
    volume = mph.Volume(array, mph.Grid.centered(array.shape, 5.0), "activity")
    recipe = mph.Recipe({"model.kind": "emission", "model.time": 600.0, "model.background": 0.5, "noise.seed": 1,
                         "detector.rows": 32, "detector.columns": 32})  # fmt: skip
    expected = next(mph.run_recipe(recipe.updated({"noise.seed": None}), head, volume))
    total = 600 * SHARE * 2.0 * 6 * 5 * 7 * 5.0**3
    assert expected.unit == "counts" and expected.projections.sum(axis=(1, 2)) == pytest.approx(
        total + 0.5 * 32**2, rel=0.02
    )
    run = next(mph.run_recipe(recipe, head, volume))
    mph.write_run(run, tmp_path / "run.h5")
    run = mph.read_run(tmp_path / "run.h5")
    assert run.system.kind == head.kind and np.all(run.projections % 1 == 0)
    changes = {"reconstruction.method": "mlem", "reconstruction.iterations": 10, "reconstruction.voxels": 24,
               "reconstruction.spacing": 5.0}  # fmt: skip
    with pytest.warns(mph.InputWarning, match="scores look better"):
        result = mph.reconstruct_run(run, run.recipe.updated(changes)).volume
    assert result.array.sum() == pytest.approx(volume.array.sum(), rel=0.05)
    assert np.corrcoef(result.array.ravel(), volume.array.ravel())[0, 1] > 0.9
    assert mph.run_line_integrals(expected)[0].sum() * 25 == pytest.approx(2.0 * 6 * 5 * 7 * 5.0**3, rel=1e-3)


def test_settings_that_its_model_does_not_have_are_refused(head):
    recipe = mph.Recipe({"model.kind": "emission", "model.crystal_mu": "NaI"})
    with pytest.raises(
        mph.InputError, match=r"model.crystal_mu: is no setting of the counts of a scanner of the kind toy"
    ):
        next(mph.run_recipe(recipe, head))
