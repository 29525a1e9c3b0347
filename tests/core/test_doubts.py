"""What looks wrong, though it may be meant, is warned of with the number that looks so; what is usual, is not."""

from __future__ import annotations

import re
import tomllib

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core import events
from mphdrr.core.events.templates import TEMPLATES, template_text
from mphdrr.core.runs.presets import PRESETS

from .conftest import EVENT_RECIPE, WORKBOOK, warned
from .small_events import small_recipe

GRID = mph.Grid.centered(8, 12.0)
USUAL = {"hole": "point", "pixel_points": 1, "tolerance": 1e9}


def full(value: float, grid: mph.Grid = GRID, quantity: str = "mu") -> mph.Volume:
    return mph.Volume(np.full(grid.shape, value), grid, quantity)


def project(system, grid=GRID, **options) -> list[str]:
    return warned(lambda: mph.Projector(grid, system.views((6, 6)), mph.Emission(system, **USUAL, **options)))


# Attenuation


@pytest.mark.parametrize(
    ("isotope", "material"),
    [(None, "water"), ("Tl-201", "bone"), ("In-111", "adipose tissue"), ("F-18", "bone"), ("Xe-133", "PMMA")],
)
def test_an_attenuation_ten_times_too_large_is_named(system, isotope, material):
    energy = 140.5 if isotope is None else mph.ISOTOPES[isotope].window[0] / 0.9
    mu = mph.attenuation(material, energy)
    assert project(system, mu=full(mu), isotope=isotope) == []
    (text,) = project(system, mu=full(10 * mu), isotope=isotope)
    assert text.startswith(f"mu is {10 * mu:.3g} 1/mm where most photons are lost") and "1/cm" in text


def test_bodies_with_a_little_metal_attenuate_as_usual(system):
    grid = mph.Grid.centered((32, 22, 38), 12.0, (35.0, -30.0, -30.0))
    body = mph.CardiacTorso().voxelize(grid, quantity="mu").array.copy()
    assert project(system, grid, mu=mph.Volume(body, grid, "mu"), isotope="Tc-99m") == []
    body[15:17, 15:17, 15:17] = mph.attenuation("lead", 140.5)  # 2 % of what it attenuates or so
    share = body[15:17, 15:17, 15:17].sum() / body.sum()
    assert 0.02 < share < 0.3
    assert project(system, grid, mu=mph.Volume(body, grid, "mu"), isotope="Tc-99m") == []
    assert project(system, grid, mu=full(0.0, grid)) == []


@pytest.mark.parametrize(
    ("name", "isotope"), [("aperture_mu", "Tl-201"), ("crystal_mu", "Lu-177"), ("aperture_mu", "F-18")]
)
def test_a_material_that_there_is_not_is_named(system, name, isotope):
    energy = mph.ISOTOPES[isotope].window[0] / 0.9
    for material in ("tungsten", "lead", "gold", "uranium", "CZT", "NaI"):
        assert project(system, isotope=isotope, **{name: material}) == []
        assert project(system, isotope=isotope, **{name: mph.attenuation(material, energy)}) == []
    densest = max(mph.attenuation(material, energy) for material in mph.MATERIALS)
    (text,) = project(system, isotope=isotope, **{name: 2 * densest})
    assert text.startswith(f"{name} is {2 * densest:g} 1/mm, more than any material's")
    assert project(system, isotope=isotope, aperture_mu=10 * mph.attenuation("tungsten", energy)) != [], "as 1/cm"


@pytest.mark.parametrize("preset", sorted(set(PRESETS) - {"ideal"})[::2])
def test_presets_are_taken_without_a_word(scanner, preset):
    recipe = mph.Recipe(
        {"detector.plane": "real", "model.tolerance": 1e9, "model.pixel_points": 1, "model.kind": "emission"}
    )
    recipe = recipe.updated(PRESETS[preset].changes)
    volume = full(3.0, mph.Grid.centered(6, 20.0), "activity")
    small = recipe.updated({"detector.rows": 4, "detector.columns": 4})
    assert warned(lambda: next(mph.run_recipe(small, scanner[:3], volume))) == []


# Lengths and angles


@pytest.mark.parametrize("shape", [4, 16, (64, 32, 8)])
def test_a_grid_in_metres_is_named_beside_the_scanner(system, shape):
    metres = mph.Grid.centered(shape, 0.2 / np.max(shape))
    for model in (mph.Emission(system, **USUAL), mph.Transmission()):
        (text,) = warned(lambda model=model: mph.Projector(metres, system.views((5, 5)), model))
        assert text.startswith("the grid is 0.2 mm wide, ") and text.endswith("is it in metres?")
    millimetres = mph.Grid.centered(shape, 200 / np.max(shape))
    assert warned(lambda: mph.Projector(millimetres, system.views((5, 5)))) == []


def test_single_small_voxels_are_no_grid_in_metres(system):
    for size in (0.05, 0.2, 0.9):
        assert project(system, mph.Grid.centered(1, size)) == []
        assert project(system, mph.Grid.centered(3, size, (20.0, 5.0, -9.0))) == []


def test_angles_in_degrees_are_named(system):
    for angles, most in (((45.0, 0.0, 0.0), 45), ((30.0, 30.0, 30.0), 30), ((0.0, -120.0, 0.0), 120)):
        (text,) = warned(lambda angles=angles: mph.euler_pose(*angles))
        assert text.startswith(f"Euler angles: {most} rad is more than a full turn") and "degrees" in text
    (text,) = warned(lambda: mph.parallel_views(np.arange(0, 180, 3), (4, 4), 1.0))
    assert text.startswith("angles: 177 rad is more than a full turn")
    assert "25 rad" in warned(lambda: mph.regular_polygon(6, 200.0, 25.0))[0]
    ring = {"pinhole_diameter": 2.3, "detector_side": 50.0, "detector_thickness": 10.0, "roi_radius": 60.0}
    assert "rotation: 30 rad" in warned(lambda: mph.ellipse_rings(6, (250, 220), [0.0], rotation=30.0, **ring))[0]
    assert "azimuths: 200 rad" in warned(lambda: mph.ellipse_rings([10.0, 90.0, 210.0], (250, 220), [0.0], **ring))[0]


def test_angles_of_more_than_a_turn_that_are_meant_are_taken(rng):
    def usual():
        mph.euler_pose(*rng.uniform(-2 * np.pi, 2 * np.pi, 3) / 2)
        mph.euler_pose(0.0, 2 * np.pi, 0.0)
        mph.parallel_views(np.linspace(0, 2 * np.pi, 90), (4, 4), 1.0)
        mph.parallel_views(np.pi + np.linspace(0, 2 * np.pi, 90), (4, 4), 1.0)
        mph.parallel_views(-np.linspace(0, 2 * np.pi, 90, endpoint=False), (4, 4), 1.0)

    assert warned(usual) == []


def test_torch_angles_in_degrees_are_named():
    torch = pytest.importorskip("torch")
    from mphdrr.core.exchange.diffdrr import convert

    kind = {"parameterization": "euler_angles", "convention": "ZXY"}
    rotation, translation = torch.tensor([[30.0, 0.0, 80.0]]), torch.tensor([[0.0, 800.0, 0.0]])
    (text,) = warned(lambda: convert(rotation, translation, **kind))
    assert "80 rad is more than a full turn" in text
    assert warned(lambda: convert(rotation, translation, degrees=True, **kind)) == []
    assert warned(lambda: convert(torch.deg2rad(rotation), translation, **kind)) == []


# Reconstruction


def test_a_mask_without_voxels_is_named(system):
    A = mph.Projector(GRID, system.views((5, 5)), mph.Emission(system, **USUAL))
    for method in (mph.osem, mph.bsrem, mph.cgls):
        texts = warned(lambda method=method: method(A, np.ones(A.shape_out), 1, mask=np.zeros(GRID.shape, bool)))
        assert texts == [f"mask: 0 of {GRID.n_voxels} voxels are inside: the volume will be 0"]
        some = np.zeros(GRID.shape, bool)
        some[3, 3, 3] = True
        counts = A(some.astype(np.float32))
        assert warned(lambda method=method, some=some, y=counts: method(A, y, 1, mask=some)) == []


@pytest.mark.parametrize("form", ["number", "modules", "images"])
def test_a_background_that_is_given_twice_is_named(system, form):
    system = system.replace(tilt=0.0)  # or the counts, which are noise alone, are likelier in another order
    views = system.views((5, 5))
    background = {"number": 1.5, "modules": np.full(12, 1.5), "images": np.full((12, 5, 5), 1.5)}[form]
    A = mph.Projector(GRID, views, mph.Emission(system, background=background, **USUAL))
    counts = np.random.default_rng(3).poisson(9.0, A.shape_out)
    for method in (mph.osem, mph.bsrem):
        (text,) = warned(lambda method=method: method(A, counts, 1, background=background))
        assert text.startswith("background: 1.5 counts per pixel, besides 1.5 of the projector's model")
        assert warned(lambda method=method: method(A, counts, 1)) == []
    bare = mph.Projector(GRID, views, mph.Emission(system, **USUAL))
    assert warned(lambda: mph.mlem(bare, counts, 1, background=background)) == []


def ball(grid: mph.Grid, middle, radius: float) -> np.ndarray:
    index = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1)
    points = index @ grid.affine[:3, :3].T + grid.affine[:3, 3]
    return (((points - middle) ** 2).sum(axis=-1) < radius**2).astype(float)


SCENES = {
    "a ball beside the middle": lambda grid: 9 * ball(grid, (20, -15, 10), 14),
    "a ball in the middle": lambda grid: 2 * ball(grid, (0, 0, 0), 45),
    "two in a warm body": lambda grid: ball(grid, (0, 0, 0), 55) + 9 * ball(grid, (25, 5, -15), 10) * 2,
    "all of the grid": lambda grid: np.ones(grid.shape),
}


@pytest.mark.parametrize(
    "scene", [*list(SCENES)[:2], *(pytest.param(scene, marks=pytest.mark.long) for scene in list(SCENES)[2:])]
)
@pytest.mark.parametrize("which", [slice(None, None, 3), pytest.param(slice(5, 25), marks=pytest.mark.long)])
def test_counts_of_modules_in_reversed_order_are_named_and_others_are_not(scanner, scene, which, rng):
    """With attenuation, blur, scatter and modules of unequal gain that the reconstruction knows nothing of."""
    system, grid = scanner[which], mph.Grid.centered(24, 6.0)
    views = system.views((20, 20), "real")
    mu = mph.Volume(0.0154 * ball(grid, (0, 0, 0), 68), grid, "mu")
    model = mph.Emission(system, mu, 2000.0, isotope="Tc-99m", hole="depth", intrinsic_fwhm=3.0, crystal_mu="CZT")
    made = mph.Projector(grid, views, model)
    mean = made(SCENES[scene](grid)) * rng.uniform(0.9, 1.1, (len(system), 1, 1))
    counts = rng.poisson(mean + 0.2 * mean.mean())
    coarse = mph.Grid.centered((12, 11, 10), 13.0)
    A = mph.Projector(coarse, views, mph.Emission(system, isotope="Tc-99m", **USUAL))
    assert warned(lambda: mph.osem(A, counts, 1)) == []
    texts = warned(lambda: mph.osem(A, counts[::-1], 1))
    assert len(texts) == 1 and "modules in reversed order (log-likelihood " in texts[0], texts


@pytest.mark.parametrize("method", [mph.mlem, mph.osem, mph.bsrem])
def test_every_method_of_counts_doubts_their_order(system, method, rng):
    A = mph.Projector(GRID, system.views((12, 12)), mph.Emission(system, time=3e5, **USUAL))
    counts = rng.poisson(A(ball(GRID, (25, 10, -5), 20)))
    assert warned(lambda: method(A, counts, 1)) == []
    (text,) = warned(lambda: method(A, counts[::-1], 1))
    assert text.startswith("counts: likelier with the modules in reversed order (log-likelihood ")
    run = mph.counts_run(counts[::-1], system, "112-101", "back-v", 3e5)
    assert warned(lambda: method(A, run.projections, 1)) == [], "each frame is its module's again"


def test_the_order_of_counts_of_which_nothing_can_be_said_is_not_doubted(system, rng):
    A = mph.Projector(GRID, system.views((6, 6)), mph.Emission(system, **USUAL))
    for counts in (np.zeros(A.shape_out), rng.poisson(0.02, A.shape_out)):
        assert warned(lambda counts=counts: mph.mlem(A, counts, 1)) == []


# Events


def made(tmp_path, text: str) -> list[str]:
    recipe = small_recipe(tmp_path, text)
    return warned(lambda: events.make(recipe, tmp_path / "set", 1))


def test_attenuation_at_another_energy_is_named_in_events_too(tmp_path):
    (tmp_path / "a.toml").write_text(
        "mu_energy = 71\n[[shape]]\nkind = 'sphere'\nradius = 30\nactivity = 5\nmu = 0.019\n"
    )
    text = EVENT_RECIPE.replace('kind = "derenzo"', 'file = "a.toml"')
    start, end = text.index("radius = 40"), text.index("[phantoms.pose]")
    text = text[:start] + text[end:]
    said = 'time = 600\nisotope = "Tc-99m"\nattenuation = "phantom"\nwithin_crystal = true'
    said += "\npixel_points = 1\ntolerance = 1e9"
    text = text.replace("time = 600", said)
    found = made(tmp_path, text)
    assert len(found) == 1 and "holds at 71 keV, photons of 126.45 to 154.55 keV are counted" in found[0]


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(set(TEMPLATES) - {"files"}))  # whose files are the user's
def test_templates_of_event_recipes_are_taken_without_a_word(name, tmp_path):
    text = template_text(name, WORKBOOK).replace("[system]", '[system]\nmodules = "1-3"')
    truth = tomllib.loads(text)["truth"]
    voxels, spacing = np.broadcast_to(truth["voxels"], 3), np.broadcast_to(truth["spacing"], 3)
    fewer = -(-voxels // 8)
    sizes = {"voxels": fewer, "spacing": voxels * spacing / fewer, "rows": 8, "columns": 8, "gates": 1}
    for key, value in sizes.items():
        text = re.sub(rf"^{key} = .*$", f"{key} = {np.asarray(value).tolist()}", text, flags=re.M)
    assert [text for text in made(tmp_path, text) if "single voxel" not in text] == []
