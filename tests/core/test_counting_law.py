"""One law of counting: points, maps, projections and cameras in torch count the same, and torch differentiates it."""

import copy
import pickle

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics.performance import Modules
from mphdrr.core.runs.presets import PRESETS

from .conftest import emission

CENTER, SIDE, PIXELS, PITCH = np.array([9.0, -6.0, 13.0]), 3.0, 600, 0.0033
SIZES = ("pinhole_diameter", "collimator_length", "detector_side", "detector_thickness")
REAL = {
    "aperture_mu": 3.1, "opening_angle": 1.3, "crystal_mu": 0.2, "photons_per_decay": 0.8, "within_cone": True,
    "within_crystal": True, "within_walls": True,
}  # fmt: skip


def views_of_a_voxel(system):
    """Return fine pixels around the shadow of the voxel at `CENTER` in the first of the modules."""
    to_point = system.frames()[0] @ (CENTER - system.centers[0])
    middle = to_point[:2] / to_point[2] * system.collimator_length[0]
    return system[:1].views((PIXELS, PIXELS), "virtual", 1.0, pitch=PITCH, offset=middle)


def mean_in_voxel(values_at):
    """Return the mean of a function of points (P, 3) over the voxel, by Gauss and Legendre."""
    nodes, weights = np.polynomial.legendre.leggauss(5)
    places = np.stack(np.meshgrid(nodes, nodes, nodes), axis=-1).reshape(-1, 3) * SIDE / 2 + CENTER
    return np.einsum("a,b,c->abc", weights, weights, weights).reshape(-1) / 8 @ values_at(places)


@pytest.mark.filterwarnings("ignore::mphdrr.core.errors.InputWarning")
@pytest.mark.parametrize("name", PRESETS)
def test_in_every_preset_points_maps_and_images_count_the_same(name, system):
    model = emission(system[:1], **{**PRESETS[name].model, "intrinsic_fwhm": 0.0, "hole": "point"})
    grid = mph.Grid.centered(1, SIDE, CENTER)
    total = mph.Projector(grid, views_of_a_voxel(system), model, "cpu")(np.ones(grid.shape)).sum(dtype=float)
    counts = mean_in_voxel(lambda points: mph.sensitivity(system[:1], points, optics=model.optics)[:, 0])
    assert total / model.effective_time == pytest.approx(counts * grid.voxel_volume, rel=1e-6)
    by_map = mph.sensitivity_map(system[:1], grid, optics=model.optics).array
    assert by_map.item() == pytest.approx(mph.sensitivity(system[:1], [CENTER], optics=model.optics).item(), rel=1e-6)
    aimed = system[:1].replace(tilt=0.0)
    sizes = (getattr(aimed, name) for name in ("pinhole_distance", *SIZES))
    at_isocentre = mph.isocentre_performance(*sizes, optics=model.optics).sensitivity
    np.testing.assert_allclose(at_isocentre, mph.sensitivity(aimed, [[0, 0, 0]], optics=model.optics)[0], rtol=1e-6)


@pytest.mark.filterwarnings("ignore::mphdrr.core.errors.InputWarning")
@pytest.mark.parametrize("name", PRESETS)
def test_in_every_preset_gradients_are_the_central_differences(name, system):
    """By a module's dimensions: of sensitivity, of performance at the isocentre, and of the total counts of a camera."""
    torch = pytest.importorskip("torch", reason="torch is not installed")
    from mphdrr.core.projector.torch_cameras import emission_images

    one = system[4:5]
    model = emission(one, **{**PRESETS[name].model, "intrinsic_fwhm": 0.0, "hole": "point", "pixel_points": 3})
    optics = model.optics
    grid = mph.Grid.centered((5, 4, 6), 4.0)
    activity = mph.Volume(np.random.default_rng(1).random(grid.shape), grid, "activity")
    poses, points = torch.tensor(one.poses()), [[3.0, -8.0, 5.0], [-11.0, 2.0, -9.0]]
    given = [torch.tensor(getattr(one, size)) for size in SIZES]

    def counts(d, l, side, thickness):
        modules = Modules(torch.tensor(one.centers), torch.tensor(one.frames()), d, l, side, thickness)
        distance = torch.tensor(one.pinhole_distance)
        at_isocentre = mph.isocentre_performance(distance, d, l, side, thickness, optics=optics)
        crystal = {} if optics.crystal_mu is None else {"crystal_thickness": thickness, "crystal_side": side}
        images = emission_images(
            activity, poses[:, :3, 3], poses[:, :3, :3], l, 3.0, (9, 8), diameter=d, pixel_points=3, optics=optics,
            time=model.effective_time, backend="numpy", **crystal,
        )  # fmt: skip
        of_points = mph.sensitivity(modules, points, optics=optics).sum()
        return torch.stack([of_points, at_isocentre.sensitivity[0], images.sum()])

    total = mph.Projector(grid, one.views((9, 8), "virtual", 1.0, pitch=3.0), model, "numpy")(activity).sum()
    in_the_middle = mph.sensitivity(one.replace(tilt=0.0), [[0, 0, 0]], optics=optics)[0, 0]
    expected = (mph.sensitivity(one, points, optics=optics).sum(), in_the_middle, total)
    np.testing.assert_allclose(counts(*given), expected, rtol=1e-6)
    for i in (0, 1) if optics.crystal_mu is None else (0, 1, 3):  # by d, l and Td; the side only says what is seen
        tried = [x.clone().requires_grad_(j == i) for j, x in enumerate(given)]
        found = [torch.autograd.grad(y, tried[i], retain_graph=True)[0] for y in counts(*tried)]
        ahead, back = (counts(*(x + step * (j == i) for j, x in enumerate(given))) for step in (1e-5, -1e-5))
        differences = ((ahead - back) / 2e-5).tolist()
        for slope, difference, size in zip(found, differences, expected, strict=True):
            assert float(slope) == pytest.approx(difference, rel=1e-6, abs=1e-10 * size)  # rounding


@pytest.mark.parametrize("edge", ["paix", "path"])
def test_the_law_is_the_same_for_every_edge_layer_and_module(edge, system):
    """Also where modules have coefficients of their own, and where the crystal's depth, cone or side take photons away."""
    rng = np.random.default_rng(7)
    own = {**REAL, "edge": edge, "crystal_mu": rng.uniform(0.05, 0.4, 12), "aperture_mu": rng.uniform(2, 5, 12)}
    points = rng.uniform(-60, 60, (30, 3))
    together = mph.sensitivity(system, points, depth_layers=3, **own)
    model = emission(system, depth_layers=3, aperture_points=1, **own)
    for m in range(12):
        optics = {**own, "crystal_mu": own["crystal_mu"][m], "aperture_mu": own["aperture_mu"][m]}
        alone = mph.sensitivity(system[m : m + 1], points, depth_layers=3, **optics)[:, 0]
        np.testing.assert_allclose(together[:, m], alone, rtol=1e-12)
        x_u, x_v, h = system.frames()[m] @ (points - system.centers[m]).T
        l, (opening,) = system.collimator_length[m], model.openings(m, 1)
        counts = 0.0
        for layer, z in enumerate(np.linspace(0, system.detector_thickness[m], 3)):
            places = ((l + z) * x / h for x in (x_u, x_v))
            weights = model.pixel_weights(m, *places, (1e-3, 1e-3), l, opening, layer) * 1e6
            counts += weights * ((l + z) / h) ** 2 * np.sqrt(1 + (x_u**2 + x_v**2) / h**2)
        np.testing.assert_allclose(together[:, m], counts, rtol=1e-6, atol=1e-12)
    assert 0 < np.count_nonzero(together) < together.size


def test_a_narrow_cone_counts_what_it_lets_pass(system):
    point = [[0.0, 0.0, 40.0]]
    wide, narrow = (mph.sensitivity(system, point, opening_angle=angle, within_cone=True) for angle in (2.0, 0.1))
    assert (wide > 0).all() and not narrow.any()


@pytest.mark.parametrize("edge", ["paix", "path"])
def test_gradients_by_every_number_are_the_central_differences(edge, system):
    """Of sensitivity, resolution and magnification by points, modules and optics, where all modules see the points."""
    torch = pytest.importorskip("torch", reason="torch is not installed")
    two = system[2:4]
    points = [[3.0, -8.0, 5.0], [-11.0, 2.0, -9.0]]
    numbers = {"aperture_mu": [3.0, 2.2], "opening_angle": 1.4, "crystal_mu": [0.3, 0.1], "photons_per_decay": 0.9}
    given = [points, *Modules.from_system(two), *numbers.values(), 2.0]
    given = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in given]

    def values(points, *rest):
        modules, optics = Modules(*rest[:6]), dict(zip((*numbers, "intrinsic_fwhm"), rest[6:], strict=True))
        counts = mph.sensitivity(modules, points, edge=edge, depth_layers=2, within_crystal=True, **optics)
        return 1e6 * counts, mph.resolution(modules, points, **optics), mph.magnification(modules, points)

    expected = 1e6 * mph.sensitivity(two, points, edge=edge, **numbers)
    np.testing.assert_allclose(values(*given)[0].detach(), expected, rtol=1e-12)
    assert torch.autograd.gradcheck(values, given, atol=1e-6, rtol=1e-6, check_undefined_grad=False, fast_mode=True)


def test_performance_at_the_isocentre_is_differentiable_by_a_modules_dimensions():
    torch = pytest.importorskip("torch", reason="torch is not installed")
    numbers = [200.0, 2.0, 60.0, 50.0, 10.0]
    given = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in numbers]
    optics = {"crystal_mu": 0.2, "aperture_mu": 3.0, "intrinsic_fwhm": 3.0}

    def values(*numbers):
        sensitivity, *others = mph.isocentre_performance(*numbers, **optics)
        return 1e6 * sensitivity, *others

    expected = mph.isocentre_performance(*numbers, **optics)
    np.testing.assert_allclose([float(x) for x in values(*given)], [1e6 * expected[0], *expected[1:]], rtol=1e-14)
    assert torch.autograd.gradcheck(values, given, atol=1e-6, rtol=1e-6)


@pytest.mark.filterwarnings("ignore::mphdrr.core.errors.InputWarning")
def test_cameras_of_tensors_count_as_the_model_with_the_same_optics(system):
    """Through cone, walls, edge and layers of modules with their own coefficients; their totals' gradients are right."""
    torch = pytest.importorskip("torch", reason="torch is not installed")
    from mphdrr.core.projector.torch_cameras import emission_images

    two = system[4:6]
    own = {**REAL, "crystal_mu": [0.3, 0.1], "aperture_mu": [3.0, 1.2], "edge": "path", "depth_layers": 2}
    model = emission(two, aperture_points=3, pixel_points=2, **own)
    grid = mph.Grid.centered((5, 4, 6), 4.0)
    activity = mph.Volume(np.random.default_rng(1).random(grid.shape), grid, "activity")
    poses = torch.tensor(two.poses())
    l, d, thickness, side = (
        torch.tensor(getattr(two, name))
        for name in ("collimator_length", "pinhole_diameter", "detector_thickness", "detector_side")
    )

    def images(position, l, d, thickness):
        return emission_images(
            activity, position, poses[:, :3, :3], l, 3.0, (9, 8), (18.0, 0.0), diameter=d, aperture_points=3,
            pixel_points=2, crystal_thickness=thickness, crystal_side=side, optics=model.optics, backend="numpy",
        )  # fmt: skip

    given = [poses[:, :3, 3], l, d, thickness]
    views = two.views((9, 8), "virtual", 1.0, pitch=3.0, offset=(18.0, 0.0))
    expected = mph.Projector(grid, views, model, "numpy")(activity)
    np.testing.assert_allclose(images(*given), expected, rtol=1e-9, atol=1e-12 * expected.max())
    assert 0 < np.count_nonzero(expected) < expected.size
    for i in (1, 3):  # by l and thickness; where the volume has no edges, the pose's are in test_emission_gradients.py
        step = torch.zeros(2, dtype=torch.float64)
        step[0] = 1e-5
        moved = [[x + sign * step if j == i else x for j, x in enumerate(given)] for sign in (1, -1)]
        tried = [x.clone().requires_grad_(j == i) for j, x in enumerate(given)]
        images(*tried).sum().backward()
        difference = (images(*moved[0]).sum() - images(*moved[1]).sum()) / 2e-5
        assert float(tried[i].grad[0]) == pytest.approx(float(difference), rel=1e-6)


def test_optics_and_models_are_copied_and_pickled(system):
    """As for other processes, and by packages that copy their physics."""
    model = mph.Emission(system, isotope="Tc-99m", aperture_mu="tungsten", crystal_mu="NaI")
    expected = mph.sensitivity(system, [CENTER], optics=model.optics)
    for same in (copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
        np.testing.assert_array_equal(mph.sensitivity(system, [CENTER], optics=same.optics), expected)
