"""The projector in other packages, with the packages themselves: `make test-peers` runs these tests with all of them."""

import copy
import importlib.util
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core import errors
from mphdrr.core.reconstruction import adapters

from .conftest import emission, refused


@pytest.fixture(scope="module")
def problem(scanner):
    """Return a projector of 20 modules with a background, a truth, and counts of it."""
    system, grid = scanner[::4], mph.Grid.centered(12, 7.0)
    model = emission(system, time=600.0, background=np.linspace(0.2, 1.5, len(system)), aperture_points=3)
    A = mph.Projector(grid, system.views((16, 14), detector="real"), model)
    rng = np.random.default_rng(4)
    truth = np.zeros(grid.shape, np.float32)
    truth[2:10, 2:10, 3:9] = rng.uniform(20, 100, (8, 8, 6))
    counts = mph.sample_counts(A(truth) + A.background, 3).astype(np.float32)
    return SimpleNamespace(A=A, truth=truth, counts=counts)


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch", reason="no torch")


@pytest.fixture(scope="module")
def deepinv(torch):
    if importlib.util.find_spec("deepinv") is None:
        pytest.skip("no deepinv")
    try:
        import torchvision  # noqa: F401
    except RuntimeError:  # it is built for another torch than a CPU one, and asks for these operators of its own
        library = torch.library.Library("torchvision", "DEF")
        for name in ("nms", "qnms"):
            library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        sys.modules.pop("torchvision", None)
        torch.keep_of_the_test = library
    import deepinv

    return deepinv


@pytest.fixture(scope="module")
def pytomography(torch):
    return pytest.importorskip("pytomography", reason="no PyTomography")


@pytest.fixture
def likelihood(problem, pytomography, torch):
    """Return PyTomography's likelihood of the counts."""
    from pytomography.likelihoods import PoissonLogLikelihood

    matrix = mph.pytomography_matrix(problem.A)
    return PoissonLogLikelihood(matrix, torch.tensor(problem.counts), torch.tensor(problem.A.background))


def close(found, expected, most=1e-4):
    """Check that two volumes differ by at most this share: of the norm, and in any voxel of the largest value."""
    found, expected = np.asarray(found, float), np.asarray(expected, float)
    assert np.linalg.norm(found - expected) <= most * np.linalg.norm(expected)
    assert np.abs(found - expected).max() <= most * np.abs(expected).max()


def test_deepinv_says_that_the_adjoint_is_exact(problem, deepinv, torch):
    physics = mph.deepinv_physics(problem.A)
    assert isinstance(physics, deepinv.physics.LinearPhysics)
    torch.manual_seed(1)
    assert physics.adjointness_test(img_size=(2, *problem.A.shape_in), num_samples=3) <= 1e-5
    x = torch.rand(2, 1, *problem.A.shape_in)
    torch.testing.assert_close(physics.A(x)[1, 0], problem.A(x[1, 0]))
    norm = physics.compute_sqnorm(x[:1], max_iter=30, verbose=False)
    rough = physics.A_adjoint_A(x[:1]).norm() / x[:1].norm()
    assert 0.8 * rough <= norm <= 5 * rough


def test_deepinvs_mlem_and_osem_are_ours(problem, deepinv, torch):
    A, physics = problem.A, mph.deepinv_physics(problem.A)
    counts = torch.tensor(problem.counts)[None, None]
    with torch.no_grad():
        found = deepinv.optim.MLEM(max_iter=5)(counts, physics)
        close(found[0, 0], mph.mlem(A, problem.counts, 5).volume.array)
        split = physics.split_physics(6), physics.split_measurements(counts, 6)
        found = deepinv.optim.OSEM(max_iter=2, num_subsets=6)(split[1], split[0])
        close(found[0, 0], mph.osem(A, problem.counts, 2, 6).volume.array)


def test_deepinv_simulates_with_the_background_and_has_gradients(problem, deepinv, torch):
    A, physics = problem.A, mph.deepinv_physics(problem.A)
    x = torch.tensor(problem.truth)[None, None]
    np.testing.assert_allclose(physics(x)[0, 0], A(problem.truth) + A.background, rtol=1e-6)
    noisy = mph.deepinv_physics(A, noise_model=deepinv.physics.PoissonNoise())(x)
    assert (noisy == noisy.round()).all() and float(noisy.sum()) == pytest.approx(float(physics(x).sum()), rel=0.05)
    x.requires_grad_()
    physics.A(x).sum().backward()
    torch.testing.assert_close(x.grad[0, 0], A.T(torch.ones(A.shape_out)))
    assert copy.deepcopy(physics).A(x.detach()).shape == (1, 1, *A.shape_out)
    bare = mph.deepinv_physics(mph.Projector(A.grid, A.views))
    torch.testing.assert_close(bare(x.detach()), bare.A(x.detach()))


def test_pytomographys_adjoint_is_exact_and_its_subsets_are_balanced(problem, pytomography, torch):
    A, matrix = problem.A, mph.pytomography_matrix(problem.A)
    assert isinstance(matrix, pytomography.projectors.SystemMatrix)
    x, y = torch.rand(A.shape_in), torch.rand(A.shape_out)
    total = torch.zeros(A.shape_in)
    matrix.set_n_subsets(6)
    for k in (None, *range(6)):
        images, part = matrix.forward(x, k), matrix.get_projection_subset(y, k)
        back = matrix.backward(part, k)
        forward = float((images.double() * part).sum())
        assert float((x.double() * back).sum()) == pytest.approx(forward, rel=1e-5)
        torch.testing.assert_close(images, matrix.get_projection_subset(matrix.forward(x), k))
        total += 0 if k is None else matrix.compute_normalization_factor(k)
    torch.testing.assert_close(total, matrix.compute_normalization_factor())
    assert sum(matrix.get_weighting_subset(k) for k in range(6)) == pytest.approx(1)
    sizes = [len(which) for which in matrix.subset_indices_array]
    assert sum(sizes) == 20 and max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize("subsets", [1, 6])
def test_pytomographys_osem_is_ours(problem, likelihood, subsets):
    from pytomography.algorithms import OSEM

    found = OSEM(likelihood)(n_iters=2, n_subsets=subsets)
    close(found, mph.osem(problem.A, problem.counts, 2, subsets).volume.array)


def test_pytomographys_bsrem_climbs_with_a_prior(problem, likelihood):
    from pytomography.algorithms import BSREM
    from pytomography.priors import RelativeDifferencePrior

    A = problem.A

    def value(x):
        expected = A(np.asarray(x)).astype(float) + A.background
        return (problem.counts * np.log(expected) - expected).sum()

    prior = RelativeDifferencePrior(beta=0.1, gamma=2)
    found = BSREM(likelihood, prior=prior, relaxation_sequence=lambda n: 1 / (1 + n / 10))(n_iters=4, n_subsets=4)
    assert value(found) > value(mph.mlem(A, problem.counts, 2).volume.array)
    assert not np.isnan(np.asarray(found)).any()


def test_scipy_solves_with_it(problem, rng):
    linalg = pytest.importorskip("scipy.sparse.linalg", reason="no scipy")
    A, operator = problem.A, mph.scipy_operator(problem.A)
    assert isinstance(operator, linalg.LinearOperator) and operator.shape == (20 * 16 * 14, 12**3)
    x, y = rng.normal(size=operator.shape[1]), rng.normal(size=operator.shape[0])
    forward = float(y @ operator.matvec(x))
    scale = np.linalg.norm(operator.matvec(x)) * np.linalg.norm(y)
    assert abs(forward - float(operator.rmatvec(y) @ x)) <= 1e-5 * scale
    np.testing.assert_array_equal(operator @ x, A(x.reshape(A.shape_in)).ravel())
    columns = rng.normal(size=(operator.shape[1], 3))
    np.testing.assert_array_equal((operator @ columns)[:, 2], operator @ columns[:, 2])
    rows = rng.normal(size=(operator.shape[0], 2))
    np.testing.assert_array_equal((operator.H @ rows)[:, 1], operator.T @ rows[:, 1])
    largest = linalg.svds(operator, 1, return_singular_vectors=False)[0]
    assert largest == pytest.approx(mph.parallelproj_operator(A).norm(num_iter=60), rel=1e-3)
    found = linalg.lsqr(operator, A(problem.truth).ravel(), iter_lim=15)[0]
    assert np.linalg.norm(operator @ found - A(problem.truth).ravel()) < 0.05 * np.linalg.norm(A(problem.truth))
    assert mph.scipy_operator(A.T).shape == operator.shape[::-1]


def test_parallelprojs_loop_of_subsets_is_our_osem(problem):
    """Its example's EM update: ``x * A^H(y / (A x + s)) / A^H 1``, over a sequence of operators."""
    A = problem.A
    from mphdrr.core.projector.subsets import in_access_order

    operators = [(mph.parallelproj_operator(part), part.which) for part in in_access_order(A.subsets(6))]
    ones = [op.adjoint(np.ones(op.out_shape, np.float32)) for op, _ in operators]
    x = np.ones(operators[0][0].in_shape, np.float32)
    for _ in range(2):
        for (op, which), one in zip(operators, ones, strict=True):
            ratio = problem.counts[which] / (op(x) + A.background[which])
            x = np.divide(x * op.adjoint(ratio), one, out=np.zeros_like(x), where=one > 0)
    close(x, mph.osem(A, problem.counts, 2, 6).volume.array)


def test_parallelprojs_methods(problem, rng):
    A, op = problem.A, mph.parallelproj_operator(problem.A)
    assert op.in_shape == A.shape_in and op.out_shape == A.shape_out
    assert op.adjointness_test(rtol=1e-5) and op.H.adjointness_test(rtol=1e-5)
    x, y = rng.uniform(size=op.in_shape), rng.uniform(size=op.out_shape)
    np.testing.assert_array_equal(op.apply(x), A(x))
    np.testing.assert_array_equal(op.H(y), A.T(y))
    op.scale = -2.5
    np.testing.assert_allclose(op(x), -2.5 * A(x))
    np.testing.assert_allclose(op.adjoint(y), -2.5 * A.T(y))
    np.testing.assert_allclose(op.H.H(x), op(x))
    with pytest.raises(mph.InputError, match="scale"):
        op.scale = "much"


def test_parallelprojs_own_operators_combine_with_it(problem, rng):
    operators = pytest.importorskip("parallelproj.operators", reason="no parallelproj")
    op = mph.parallelproj_operator(problem.A)
    weights = rng.uniform(0.5, 1, op.out_shape).astype(np.float32)
    both = operators.CompositeLinearOperator([operators.ElementwiseMultiplicationOperator(weights), op])
    x = rng.uniform(size=op.in_shape).astype(np.float32)
    np.testing.assert_allclose(both(x), weights * problem.A(x), rtol=1e-6)
    assert both.adjointness_test(np, rtol=1e-5)
    stacked = operators.LinearOperatorSequence([mph.parallelproj_operator(part) for part in problem.A.subsets(3)])
    assert sum(one.size for one in stacked(x)) == np.prod(op.out_shape)


ADAPTERS = [mph.scipy_operator, mph.deepinv_physics, mph.pytomography_matrix, mph.parallelproj_operator]


@pytest.mark.parametrize("make", ADAPTERS[:3])
def test_a_missing_package_is_named_with_what_installs_it(problem, make, monkeypatch):
    package = make.__name__.partition("_")[0]

    def missing(*_):
        raise ModuleNotFoundError(f"No module named '{package}'", name=package)

    monkeypatch.setattr(adapters.importlib, "import_module", missing)
    refused(lambda: make(problem.A), f"^{package}: {package} is missing: pip install {package}$")


def test_in_blender_a_missing_package_refers_to_a_section_that_there_is(monkeypatch):
    monkeypatch.setattr(errors, "__name__", "bl_ext.user_default.mphdrr.core.errors")
    with pytest.raises(mph.InputError) as refusal, errors.needing("mphdrr[learning]"):
        raise ModuleNotFoundError("No module named 'torch'", name="torch.nn")
    title, page = re.fullmatch(r'torch is missing: see "(.*)" in (docs/.*)', str(refusal.value)).groups()
    assert f"# {title}\n" in (Path(mph.__file__).parents[1] / page).read_text(encoding="utf-8")


@pytest.mark.parametrize("make", ADAPTERS)
def test_what_is_no_projector_is_refused(make):
    refused(lambda: make(np.ones((3, 4))), f"{make.__name__}: A: expected a .*(Projector|LinearOperator), got ndarray")
