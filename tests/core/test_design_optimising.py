"""Designs by gradients: derivatives against differences, optima against closed forms, searches that stop and go on."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.design import evaluating
from mphdrr.core.design.numbers import module_rows
from mphdrr.core.design.objectives import Detail, Lesion, Regions, Sensitivity, ball_points
from mphdrr.core.design.optimising import DesignLoss
from mphdrr.core.design.parameters import displacement_parameters, free_parameters
from mphdrr.core.design.penalties import (
    Clearance,
    CrystalArea,
    FieldOfView,
    LineOfSight,
    ModuleSeparation,
    SmallestHole,
    faults,
)
from mphdrr.core.design.recipe import TEMPLATE
from mphdrr.core.geometry.system import PinholeSystem
from mphdrr.core.projector import Projector

from .conftest import refused
from .small_design import BODY, PARTS, RECIPE, TEXT, small_design

pytest.importorskip("scipy", reason="SciPy is not installed")


def along(term, free, values, direction, step=1e-3) -> tuple[float, float]:
    """Return the derivative of a term along free numbers, and that by differences of the fourth order."""
    _, by_rows = term(free.build(values))
    exact = np.einsum("mr,mrk,k->", by_rows, free.jacobian(values), direction)
    at = {n: term(free.build(values + n * step * direction))[0] for n in (-2, -1, 1, 2)}
    return float(exact), (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * step)


def workbook_like(system: PinholeSystem):
    """Return a free parametrisation of places, tilts, holes and lengths of all modules."""
    limits = {"radial": [-20, 20], "along": [-20, 20], "z": [-20, 20], "tilt": [-9, 9]}
    return free_parameters(
        "workbook", displacement_parameters(system), {**limits, "diameter": [0.5, 2], "longer": [0.5, 2]}
    )


def model(system: PinholeSystem) -> mph.Emission:
    return mph.Emission(system, aperture_mu=3.6, crystal_mu=0.4, intrinsic_fwhm=2.0, hole="depth")


def crowd(system: PinholeSystem) -> PinholeSystem:
    """Return the modules so close together that they overlap and block each other, with smaller fields of view."""
    farther = np.where(np.arange(len(system)) < 6, 0.6, 0.9)[:, None]
    return replace(
        system, centers=farther * [1, 1, 0.3] * system.centers, collimator_length=1.3 * system.collimator_length
    )


@pytest.mark.parametrize(
    "term",
    [
        Sensitivity(model, ball_points(30.0, 7), 12.0),
        Detail(model, ball_points(30.0, 7), 9.0),
        Detail(model, ball_points(30.0, 7), 9.0, "gaussian"),
        FieldOfView(),
        ModuleSeparation(),
        LineOfSight(),
        Clearance((150.0, 120.0, 5.0, 0.0)),
        SmallestHole(2.5),
        CrystalArea(120.0),
    ],
    ids=lambda term: type(term).__name__,
)
def test_gradients_equal_differences(system, rng, term):
    crowded = crowd(system)
    free = workbook_like(crowded)
    values = free.start + 0.02 * (free.high - free.low) * rng.uniform(-1, 1, len(free.start))
    assert abs(term(free.build(values))[0]) > 0, "there is something to differentiate"
    if isinstance(term, CrystalArea):  # whose numbers are free in no workbook
        free = small_design(free={"detector_side": [40, 60]}).parameters
        values = free.start
    direction = rng.uniform(-1, 1, len(values)) * (free.high - free.low) / 40
    exact, found = along(term, free, values, direction)
    assert exact == pytest.approx(found, rel=1e-6)


def test_a_row_of_numbers_is_all_that_generators_give(rng):
    free = small_design().parameters
    values = free.start + 0.1 * (free.high - free.low) * rng.uniform(-1, 1, len(free.start))
    direction = 0.01 * (free.high - free.low)
    ahead, behind = (module_rows(free.build(values + sign * direction)) for sign in (1, -1))
    assert free.jacobian(values) @ direction == pytest.approx((ahead - behind) / 2, rel=1e-3, abs=1e-4)


def one_module(b=200.0, l=50.0, d=3.0) -> PinholeSystem:
    return PinholeSystem([[b, 0, 0]], d, l, 60.0, 10.0, 10.0)


def best_hole(objective, b=200.0, l=50.0) -> float:
    """Return the diameter, mm, that the search finds."""
    free = free_parameters("workbook", displacement_parameters(one_module(b, l)), {"diameter": [0.1, 5.0]})
    loss = DesignLoss(free, [(-1.0 / abs(objective(one_module(b, l))[0]), objective)])
    from scipy.optimize import minimize

    found = minimize(
        loss, [0.2], jac=True, method="L-BFGS-B", bounds=[(0.0, 1.0)], options={"ftol": 1e-14, "gtol": 1e-10}
    )
    return float(free.build(loss.values_at(found.x)).pinhole_diameter[0])


def ideal(system: PinholeSystem) -> mph.Emission:
    return mph.Emission(system, hole="depth")


@pytest.mark.parametrize(
    ("objective", "width"),
    [
        (Sensitivity(ideal, np.zeros((1, 3)), 20.0), 20.0 / np.sqrt(2)),
        (Detail(ideal, np.zeros((1, 3)), 10.0, "gaussian"), 7.50),
        (Detail(ideal, np.zeros((1, 3)), 10.0, "disc"), 11.72),
    ],
)
def test_the_best_holes_shadow_has_the_width_of_the_closed_form(objective, width):
    """Of a target resolution: by root two (Fessler 1998).

    For rods: sensitivity in proportion to d^2, a signal of frequency 1 / (2 D), the largest d^2 MTF^2.
    """
    assert best_hole(objective) * (1 + 200 / 50) == pytest.approx(width, rel=1e-2)


@pytest.mark.parametrize("worst", [False, True])
@pytest.mark.parametrize("kind", ["lesion", "regions"])
def test_gradients_of_images_equal_differences(kind, worst, rng):
    recipe = small_design(objectives=[{"kind": kind, "body": [BODY], "parts": PARTS, "worst": worst}])

    def projector(system):
        return Projector(recipe.grid(), system.views((8, 8), "real"), recipe.model(system), double=True)

    objective = replace(recipe.wanted()[0], make_projector=projector)
    free = recipe.parameters
    direction = rng.uniform(-1, 1, len(free.start)) * (free.high - free.low) / 1000
    exact, found = along(objective, free, free.start, direction, 1e-3)
    assert exact == pytest.approx(found, rel=1e-6)


def test_an_ideal_observer_sees_a_lesion_as_its_counts_say():
    """Nothing but the lesion's own counts: SNR^2 is their number; twice the time, twice as many."""
    recipe = small_design(model={"time": 60.0})
    system = recipe.parameters.build(recipe.parameters.start)
    (part, *_) = recipe.volumes(PARTS, apart=True)
    value, _ = Lesion(recipe.projector, [part], [part])(system)
    assert value**2 == pytest.approx(float(recipe.projector(system)(part).sum()), rel=1e-5)
    regions, _ = Regions(recipe.projector, [part], [part])(system)
    assert regions == pytest.approx(value, rel=1e-9), "of one region alone, its precision is its SNR"


def test_a_search_gets_better_and_passes_the_checks(tmp_path):
    seen = []
    found = mph.design.optimize(small_design(), callback=lambda system, objective: seen.append(objective))
    first, last = found.values["detail 1"]
    assert found.ok and last > 1.05 * first
    assert seen == found.objective.tolist()
    mph.write_system(found.system, tmp_path / "found.xlsx")
    assert mph.check_geometry(mph.read_system(tmp_path / "found.xlsx")).ok


@pytest.mark.long
def test_a_search_that_is_stopped_keeps_the_best_and_goes_on(tmp_path):
    recipe, state = small_design(), tmp_path / "state.json"

    def stop(done, total):
        if done >= 6:
            raise mph.Cancelled

    with pytest.raises(mph.Cancelled) as stopped:
        mph.design.optimize(recipe, stop, state)
    half = stopped.value.design
    found = mph.design.optimize(recipe, state=state)
    assert found.objective[: len(half.objective)].tolist() == half.objective.tolist()
    assert len(found.objective) > len(half.objective) and found.ok
    again = mph.design.optimize(recipe, state=state)
    assert again.parameters == found.parameters, "what is done is not done again"


def test_other_contents_of_a_named_file_make_another_recipe(system, tmp_path):
    def fingerprint(radius: float, hole: float) -> str:
        (tmp_path / "body.toml").write_text(BODY.replace("20", str(radius)))
        mph.write_system(replace(system, pinhole_diameter=np.full(len(system), hole)), tmp_path / "own.xlsx")
        wanted = [{"kind": "lesion", "body": ["body.toml"], "parts": PARTS}]
        generator, free = {"kind": "workbook", "file": "own.xlsx"}, {"diameter": [0.5, 2.0]}
        return small_design(tmp_path, generator=generator, free=free, objectives=wanted).fingerprint

    assert len({fingerprint(20, 3.0), fingerprint(21, 3.0), fingerprint(21, 3.1)}) == 3
    assert fingerprint(21, 3.1) == fingerprint(21, 3.1)


def test_constraints_that_cannot_hold_are_said():
    recipe = small_design(constraints={"bore": 195.0}, search={"starts": 1, "coarse_steps": 2, "steps": 1})
    found = mph.design.optimize(recipe)
    assert not found.ok and "into the bore" in found.faults[-1]


def test_penalties_are_there_where_checks_find_faults(system):
    """What a penalty is 0 for, passes the check that it stands for."""
    for crowded in (system, crowd(system)):
        report = mph.check_geometry(crowded)
        assert bool(FieldOfView(margin=0.0)(crowded)[0] > 1e-4) == bool(report.uncovered)
        for penalty, findings in ((ModuleSeparation(), report.overlaps), (LineOfSight(), report.blocked)):
            assert penalty(crowded)[0] > 0 or not findings
    assert faults(system, [SmallestHole(10.0)])[-1].endswith("too narrow")
    assert faults(system, [CrystalArea(1.0)])[-1].startswith("all modules")


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"objectives": []}, "expected one [[objectives]] or more"),
        ({"objectives": [{"kind": "beauty"}]}, "objectives 1: kind 'beauty': expected one of sensitivity"),
        ({"objectives": [{"kind": "detail"}]}, "objectives 1: size: missing"),
        ({"free": {}}, "free: expected the limits"),
        ({"free": {"pinhole_diameter": [5.0, 9.0]}}, "free.pinhole_diameter: expected two rising limits around 4"),
        ({"free": {"crystals": [1, 2]}}, "free.crystals: no such entry; ellipse has kind"),
        ({"free": {"rotation": [1, 2]}}, "free.rotation: expected generator.rotation"),
        ({"free": {"z": [1, 2, 3]}}, "free.z: expected two limits, or two for each of its 2 numbers"),
        ({"generator": {"kind": "cube"}}, "generator.kind 'cube': expected one of ellipse"),
        (
            {"generator": {**RECIPE["generator"], "sides": 3}},
            "generator.sides: no such entry; ellipse has kind, modules",
        ),
        ({"generator": {k: v for k, v in RECIPE["generator"].items() if k != "roi_radius"}}, "roi_radius"),
        ({"generator": {"kind": "workbook"}, "free": {"radial": [-1, 1]}}, "generator.file: missing"),
        ({"constraints": {"bore": -1.0}}, "constraints.bore: expected a number above 0"),
        ({"serach": {}}, "serach: no such entry; expected version, generator"),
        ({"version": 2}, "version: expected 1, got 2"),
        ({"pareto": {"entry": "generator.size", "values": [1.0]}}, "pareto.entry: expected one of the recipe"),
        ({"pareto": {}}, "pareto: expected an entry"),
    ],
)
def test_bad_recipes_are_refused_in_one_line(tables, said):
    with pytest.raises(mph.InputError) as error:
        recipe = small_design(**tables)
        mph.design.pareto(recipe) if "pareto" in tables else recipe.parameters.build(recipe.parameters.start)
    assert said in str(error.value) and "\n" not in str(error.value)


@pytest.mark.long
def test_a_front_is_a_table_and_a_plot(tmp_path):
    search = {"starts": 1, "coarse_steps": 4, "steps": 1}
    pareto = {"entry": "objectives.size", "values": [6.0, 10.0]}
    front = mph.design.pareto(small_design(search=search, pareto=pareto))
    fine, coarse = front.rows
    assert fine["resolution"] < coarse["resolution"] and fine["sensitivity"] < coarse["sensitivity"]
    for name in ("front.csv", "front.json", "front.png"):
        front.write(tmp_path / name)
    assert json.loads((tmp_path / "front.json").read_text())[0]["objectives.size"] == 6.0
    assert (tmp_path / "front.csv").read_text().count("\n") == 3


@pytest.mark.long
def test_the_gain_is_judged_by_draws_of_noise():
    """Where hardly anything is counted, wider holes are better, and no scanner gains on itself."""
    evaluation = {"body": BODY, "draws": 12, "iterations": 1, "subsets": 2}
    recipe = small_design(evaluation=evaluation, model={"time": 0.02})
    start = recipe.parameters.build(recipe.parameters.start)
    wider = replace(start, pinhole_diameter=start.pinhole_diameter * 2)
    gain = mph.design.evaluate(recipe, start, wider)
    assert gain.score == "NRMSE" and gain.low < gain.gain < gain.high and gain.low > 0
    recipe = small_design(evaluation={**evaluation, "lesion": PARTS, "draws": 8}, model={"time": 30.0})
    gain = mph.design.evaluate(recipe, start, wider)
    assert gain.score == "lesion SNR" and gain.gain > 0
    same = mph.design.evaluate(recipe, start, start)
    assert same.low < 0 < same.high


def test_the_gain_is_judged_with_the_body_s_attenuation_and_scatter(monkeypatch):
    told = []

    def keep(A, counts, iterations, subsets, background):
        told.append((A, counts, background))
        return mph.osem(A, counts, iterations, subsets, background=background)

    monkeypatch.setattr(evaluating, "osem", keep)
    evaluation = {"body": BODY + "mu = 0.0154\n", "scatter": "body", "draws": 2, "iterations": 1, "subsets": 1}
    recipe = small_design(evaluation=evaluation, model={"time": 600.0, "isotope": "Tc-99m", "energy_fwhm": 0.1})
    start = recipe.parameters.build(recipe.parameters.start)
    mph.design.evaluate(recipe, start, start)
    A, counts, background = told[0]
    (values,) = recipe.volumes(BODY)
    primary = A(values).sum()
    assert primary < 0.9 * recipe.projector(start)(values).sum()
    assert 0.02 * primary < background.sum() < primary
    assert counts.sum() == pytest.approx(primary + background.sum(), abs=5 * counts.sum() ** 0.5)
    without = small_design(evaluation={**evaluation, "body": BODY}, model={"isotope": "Tc-99m", "energy_fwhm": 0.1})
    refused(lambda: mph.design.evaluate(without, start, start), "evaluation.scatter: the body scatters nothing")


def test_the_template_is_a_recipe_that_begins_with_a_scanner_that_passes(tmp_path, capsys):
    recipe = mph.design.read_design_recipe(TEMPLATE)
    start = recipe.parameters.build(recipe.parameters.start)
    assert faults(start, recipe.constraints) == ()
    path = tmp_path / "design.toml"
    assert main(["design", "new", "-o", str(path)]) == 0
    assert path.read_bytes() == TEMPLATE.read_bytes()
    assert main(["design", "new", "-o", str(path)]) == 1
    assert "it exists" in capsys.readouterr().err


@pytest.mark.long
def test_the_command_finds_what_the_function_finds(tmp_path, capsys):
    path, out = tmp_path / "design.toml", tmp_path / "new.xlsx"
    path.write_text(TEXT)
    assert main(["design", "optimize", str(path), "-o", str(out), "--json", "--quiet"]) == 0
    said = json.loads(capsys.readouterr().out)
    found = mph.design.optimize(path)
    assert said["parameters"] == found.parameters and said["faults"] == []
    with pytest.warns(mph.InputWarning, match="the sheet's is used"):
        assert np.allclose(mph.read_system(out).centers, found.system.centers, rtol=2e-9)
