"""Laws of every iterative reconstruction: resume, callbacks, cancelling, stopping, masks and what is refused."""

import dataclasses
import functools

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import BACKENDS, refused

METHODS_OF_COUNTS = [
    pytest.param(mph.mlem, id="mlem"),
    pytest.param(functools.partial(mph.osem, subsets=3), id="osem"),
    pytest.param(functools.partial(mph.osem, subsets=2, prior=mph.Quadratic(0.01)), id="osem with prior"),
    pytest.param(functools.partial(mph.bsrem, subsets=2), id="bsrem"),
    pytest.param(
        functools.partial(mph.bsrem, subsets=2, prior=mph.RelativeDifference(0.1), step_decay=0.1),
        id="bsrem with prior",
    ),
]


def tv(A, images, *given, **more):
    return mph.tv(A, images, 0.5, *given, **more)


METHODS = [*METHODS_OF_COUNTS, *(pytest.param(method, id=method.__name__) for method in (mph.sirt, mph.cgls, tv))]


@pytest.fixture(scope="module")
def problem(scanner):
    """Return five modules around 10^3 voxels: projector, counts, truth."""
    system = scanner[::16]
    grid = mph.Grid.centered(10, 8.0)
    with pytest.warns(mph.InputWarning):
        A = mph.Projector(
            grid, system.views((12, 12), detector="real"), mph.Emission(system, time=600.0, pixel_points=4)
        )
    truth = np.zeros(grid.shape, np.float32)
    truth[3:7, 3:7, 3:7] = np.random.default_rng(1).uniform(20, 100, (4, 4, 4))
    return A, mph.sample_counts(A(truth), 2), truth


def assert_same(a, b):
    np.testing.assert_array_equal(a.volume.array, b.volume.array)
    np.testing.assert_array_equal(a.objective, b.objective)
    assert a.iterations == b.iterations and a.settings == b.settings


def assert_refused(problem, method, wrong, words):
    A, counts, _ = problem
    given = {"A": A, "y": counts, "iterations": 1} | wrong(A, counts)
    refused(lambda: method(given.pop("A"), given.pop("y"), given.pop("iterations"), **given), words)


@pytest.mark.parametrize("method", METHODS)
class TestEveryMethod:
    def test_a_break_changes_nothing(self, problem, method):
        A, counts, _ = problem
        seen, whole = [], method(A, counts, 5)
        half = method(A, counts, 2)
        assert half.iterations == 2 and whole.settings["stopped"] == "iterations"
        rest = method(A, counts, 3, start=half, callback=lambda i, x: seen.append(i))
        assert_same(rest, whole)
        assert seen == [3, 4, 5]

    @pytest.mark.long
    def test_cancelled_in_the_middle_it_can_be_resumed(self, problem, method):
        A, counts, _ = problem
        calls = []

        def progress(done, total):
            calls.append(done)
            if done / total > 0.55:
                raise mph.Cancelled

        with pytest.raises(mph.Cancelled) as caught:
            method(A, counts, 4, progress=progress)
        found = caught.value.reconstruction
        assert found.iterations == 2 and found.settings["stopped"] == "cancelled" and len(calls) > 4
        assert_same(method(A, counts, 2, start=found), method(A, counts, 4))

    def test_a_file_of_it_can_be_resumed(self, problem, method, tmp_path):
        A, counts, _ = problem
        half, path = method(A, counts, 2), tmp_path / "half.h5"
        mph.write_reconstruction(half, path)
        read = mph.read_reconstruction(path)
        assert_same(read, half)
        assert_same(method(A, counts, 2, start=read), method(A, counts, 4))
        volume = mph.read_volume(path)
        np.testing.assert_array_equal(volume.array, half.volume.array)
        assert volume.grid == half.volume.grid and volume.quantity == "activity"

    def test_cancelled_by_the_callback_the_iteration_counts(self, problem, method):
        A, counts, _ = problem

        def callback(i, x):
            if i == 3:
                raise mph.Cancelled

        with pytest.raises(mph.Cancelled) as caught:
            method(A, counts, 4, callback=callback)
        assert_same(method(A, counts, 1, start=caught.value.reconstruction), method(A, counts, 4))

    def test_the_callback_sees_each_volume_and_ends_it(self, problem, method):
        A, counts, _ = problem
        seen = []

        def callback(i, x):
            seen.append(x.copy())
            assert not x.flags.writeable
            return i == 2

        found = method(A, counts, 9, callback=callback)
        assert found.iterations == len(seen) == 2 and found.settings["stopped"] == "callback"
        np.testing.assert_array_equal(seen[-1], found.volume.array)

    def test_progress_ends_full(self, problem, method):
        A, counts, _ = problem
        said = []
        method(A, counts, 2, progress=lambda done, total: said.append((done, total)))
        assert said[-1][0] == said[-1][1] and (np.diff([done / total for done, total in said]) >= 0).all()

    def test_outside_the_mask_nothing_is(self, problem, method):
        A, counts, truth = problem
        mask = truth > 0
        found = method(A, counts, 2, start=truth + 1, mask=mask)
        assert (found.volume.array[~mask] == 0).all() and found.volume.array[mask].all()

    @pytest.mark.parametrize(
        ("wrong", "words"),
        [
            (lambda A, y: {"y": y * np.nan}, "(counts|images): nan is not a finite number at index"),
            (lambda A, y: {"y": y[1:]}, "(counts|images): expected shape 5 x 12 x 12"),
            (lambda A, y: {"y": "many"}, "(counts|images): expected real numbers"),
            (lambda A, y: {"iterations": 0}, "iterations: expected a whole number"),
            (lambda A, y: {"start": np.ones((2, 2, 2))}, "start: expected shape 10 x 10 x 10"),
            (lambda A, y: {"start": other_grid()}, "start: volume: its grid"),
            (lambda A, y: {"start": mph.Reconstruction(other_grid(), np.zeros(1))}, "start: volume: its grid"),
            (
                lambda A, y: {"start": mph.Volume(np.ones(A.shape_in), A.grid, "hu")},
                "start: .*expected a volume of act",
            ),
            (lambda A, y: {"mask": np.ones(A.shape_in)}, "mask: expected booleans"),
            (lambda A, y: {"mask": np.ones(3, bool)}, "mask: expected booleans of 10 x 10 x 10"),
            (lambda A, y: {"stop": 3}, "stop: expected a StopWhen"),
            (lambda A, y: {"stop": mph.StopWhen(noise=1, region=np.ones(2, bool))}, "stop: region: expected booleans"),
            (lambda A, y: {"A": A.views}, "expected a Projector"),
        ],
    )
    def test_what_cannot_be_is_refused_in_a_line(self, problem, method, wrong, words):
        assert_refused(problem, method, wrong, words)


@pytest.mark.parametrize("method", METHODS_OF_COUNTS)
class TestEveryMethodOfCounts:
    @pytest.mark.long
    def test_other_data_cannot_go_on_with_it(self, problem, method):
        """Refused in a line, that names what differs; its volume is taken as the start of a new one."""
        A, counts, truth = problem
        half = method(A, counts, 2)
        with pytest.warns(mph.InputWarning):
            slower = mph.Projector(A.grid, A.views, dataclasses.replace(A.model, time=601.0))
            blurred = mph.Projector(A.grid, A.views, dataclasses.replace(A.model, intrinsic_fwhm=6.0))
        for B, other, more, said in (
            (A, counts[::-1], {}, "objective"),  # as many of them
            (A, mph.sample_counts(A(truth), 3), {}, "counts"),
            (A, counts, {"background": 0.1}, "background"),
            (A, counts, {"mask": truth > 0}, "objective"),
            (slower, counts, {}, "sensitivity"),
            (blurred, counts, {}, "objective"),
        ):
            call = functools.partial(method, B, other, 1, **more)
            refused(lambda call=call: call(start=half), rf"start: .* is of other .*\b{said} .*, now")
            assert call(start=half.volume).iterations == 1

    def test_it_stops_by_change_noise_and_time(self, problem, method):
        A, counts, truth = problem
        region = truth > 0
        change = method(A, counts, 500, stop=mph.StopWhen(change=1e-3))
        last, before = change.objective[-1], change.objective[-2]
        assert change.settings["stopped"] == "change" and abs(last - before) <= 1e-3 * abs(last)
        assert (np.abs(np.diff(change.objective[:-1])) > 1e-3 * np.abs(change.objective[1:-1])).all()
        noise = method(A, counts, 500, stop=mph.StopWhen(noise=0.3, region=region))
        inside = noise.volume.array[region]
        assert noise.settings["stopped"] == "noise" and inside.std() >= 0.3 * inside.mean()
        assert method(A, counts, 500, stop=mph.StopWhen(seconds=1e-9)).iterations == 1

    @pytest.mark.parametrize(
        ("wrong", "words"),
        [
            (lambda A, y: {"y": -y}, "counts: expected 0 or more, got"),
            (lambda A, y: {"background": -1}, "background: expected 0 or more"),
            (lambda A, y: {"background": [1, 2]}, "background: expected one number, 5 numbers or images"),
            (lambda A, y: {"background": "some"}, "background: expected real numbers"),
            (lambda A, y: {"background": np.inf}, "background: inf is not a finite"),
            (lambda A, y: {"start": -np.ones(A.shape_in)}, "start: expected 0 or more"),
            (lambda A, y: {"A": mph.Projector(A.grid, A.views)}, "expected a projector of emission"),
        ],
    )
    def test_what_no_counts_can_be_is_refused_in_a_line(self, problem, method, wrong, words):
        assert_refused(problem, method, wrong, words)

    @pytest.mark.long
    @pytest.mark.parametrize("backend", BACKENDS)
    def test_every_backend_finds_the_same(self, problem, method, backend):
        A, counts, _ = problem
        other = mph.Projector(A.grid, A.views, A.model, backend)
        found, expected = method(other, counts, 2), method(A, counts, 2)
        scale = expected.volume.array.max()
        np.testing.assert_allclose(found.volume.array, expected.volume.array, rtol=1e-3, atol=1e-4 * scale)
        assert_same(method(other, counts, 1, start=method(other, counts, 1)), found)

    def test_tensors_are_taken(self, problem, method):
        torch = pytest.importorskip("torch")
        A, counts, truth = problem
        found = method(A, torch.tensor(counts), 2, background=torch.tensor(0.5), start=torch.tensor(truth + 1))
        assert_same(found, method(A, counts, 2, background=0.5, start=truth + 1))


def other_grid():
    return mph.Volume(np.ones((10, 10, 10)), mph.Grid.centered(10, 7.0))


@pytest.mark.parametrize(
    "given", [{}, {"change": 0}, {"noise": 0.1}, {"region": np.ones(3, bool)}, {"seconds": -1}, {"change": "soon"}]
)
def test_rules_that_say_nothing_are_refused(given):
    refused(lambda: mph.StopWhen(**given), "stop: ")


def test_another_methods_result_is_only_a_start(problem):
    A, counts, _ = problem
    first = mph.osem(A, counts, 2, subsets=4)
    assert_same(mph.mlem(A, counts, 3, start=first), mph.mlem(A, counts, 3, start=first.volume))


@pytest.mark.parametrize("method", [mph.osem, mph.bsrem])
def test_other_subsets_and_priors_cannot_go_on(problem, method):
    A, counts, _ = problem
    prior = mph.RelativeDifference(0.1)
    half, plain = method(A, counts, 2, 4, prior), method(A, counts, 2, 4)
    for start, subsets, other, said in (
        (half, 2, prior, "subsets 4, now 2"),
        (half, 4, mph.RelativeDifference(0.2), "weight 0.1, now 0.2"),
        (half, 4, mph.RelativeDifference(0.1, gamma=3), "gamma 2.0, now 3.0"),
        (half, 4, mph.Quadratic(0.1), "prior RelativeDifference, now Quadratic"),
        (half, 4, None, "prior RelativeDifference, now None"),
        (plain, 4, prior, "prior None, now RelativeDifference"),
    ):
        with pytest.raises(mph.InputError, match=f"start: .*{said}"):
            method(A, counts, 1, subsets, other, start=start)


def test_a_region_of_zeros_ends_nothing_and_that_is_said(problem):
    A, counts, truth = problem
    nowhere = np.zeros(A.shape_in, bool)
    nowhere[0, 0] = True
    stop = mph.StopWhen(noise=0.2, region=nowhere)
    with pytest.warns(mph.InputWarning, match="stop: region: its voxels are all 0 after iteration 1"):
        found = mph.mlem(A, counts, 4, mask=truth > 0, stop=stop)
    assert found.settings["stopped"] == "iterations" and found.iterations == 4


def test_what_nothing_can_have_caused_and_what_nobody_sees(problem):
    """Zero start values stay, counts with no cause are left out, voxels without sensitivity are 0, no counts give 0."""
    A, counts, truth = problem
    found = mph.mlem(A, counts, 3, start=np.where(truth > 0, 1, 0))
    assert (found.volume.array[truth == 0] == 0).all() and np.isfinite(found.objective).all()
    assert not mph.mlem(A, counts, 2, start=np.zeros(A.shape_in)).volume.array.any()
    empty = mph.osem(A, np.zeros_like(counts), 2, subsets=4)
    assert not empty.volume.array.any() and np.isfinite(empty.objective).all()
    far = mph.Grid.centered((30, 10, 10), 30.0)  # its corners are behind the scanner
    with pytest.warns(mph.InputWarning):
        B = mph.Projector(far, A.views, A.model)
    blind = B.T(np.ones(B.shape_out, np.float32)) == 0
    found = mph.osem(B, counts, 2, subsets=4).volume.array
    assert blind.any() and (found[blind] == 0).all() and (found[~blind] > 0).any()


def test_files_that_hold_no_reconstruction_are_refused(problem, tmp_path):
    A, counts, truth = problem
    path = tmp_path / "volume.h5"
    refused(lambda: mph.read_reconstruction(path), "no such file")
    mph.write_volume(mph.Volume(truth, A.grid), path)
    refused(lambda: mph.read_reconstruction(path), r"volume\.h5: it holds a volume, but no reconstruction")
    path.write_bytes(b"no HDF5")
    refused(lambda: mph.read_reconstruction(path), r"volume\.h5: cannot be read as")
    refused(lambda: mph.read_reconstruction(tmp_path / "volume.nii"), r"ending in \.h5, \.hdf5")
    found = mph.mlem(A, counts, 1)
    refused(lambda: mph.write_reconstruction(found, tmp_path / "none" / "a.h5"), "no such folder")
    refused(lambda: mph.write_reconstruction(found.volume, tmp_path / "a.h5"), "expected a Reconstruction")
    assert path.read_bytes() == b"no HDF5"
    mph.write_reconstruction(found, path)
    whole = path.read_bytes()
    for end in range(200, len(whole), len(whole) // 7):
        path.write_bytes(whole[:end])
        refused(lambda: mph.read_reconstruction(path))
