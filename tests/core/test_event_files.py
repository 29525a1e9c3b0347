"""The file of one event: what any reader finds in it, what it is wrong by, and that every byte of it is checked."""

from __future__ import annotations

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core import events
from mphdrr.core.events import event_files
from mphdrr.core.events.event_files import FileLocation
from mphdrr.core.hdf5 import HEADER

from .conftest import refused
from .small_events import TEXT, WORKBOOK, small_recipe

h5py = pytest.importorskip("h5py")

HALF = TEXT.replace("spacing = 6.0", 'spacing = 6.0\nstore = "float16"') + '\n[storage]\nimages = "float16"\n'


def sparse(below: float) -> str:
    return TEXT.replace("spacing = 6.0", f'spacing = 6.0\nstore = "sparse"\nbelow = {below}')


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> events.EventSet:
    folder = tmp_path_factory.mktemp("event-files")
    return events.make(small_recipe(folder), folder / "set", 2)


def stored(event: events.Event) -> dict[str, np.ndarray]:
    """Return all datasets of a file by name, read by h5py alone, with their scales."""
    found = {}

    def keep(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            found[name] = item[()] * item.attrs.get("scale", 1)

    with h5py.File(event.path, "r") as file:
        file.visititems(keep)
    return found


def test_the_images_are_of_the_truth_in_the_file(small):
    """Everything is computed anew from what h5py reads: the truth, its affine, the matrices of the views."""
    views = mph.read_system(WORKBOOK).views((14, 16))
    for event in small:
        found = stored(event)
        truth, affine = found["truth"], found["truth_affine"]
        images = mph.Projector(mph.Grid(truth.shape, affine), views, backend="numpy")(truth)
        np.testing.assert_allclose(found["images/lines"], images, rtol=1e-5, atol=1e-5 * images.max())
        # a pixel's ray: its point on the detector is where the matrix has that pixel
        row, column = 3, 11
        for m, matrix in enumerate(found["geometry/projection_matrix"]):
            _, targets = views.rays(m)
            x, y, w = matrix @ [*targets.reshape(14, 16, 3)[row, column], 1.0]
            np.testing.assert_allclose((x / w, y / w), (column, row), atol=1e-9)
        # seen along an axis, a parallel projection is the sum of the voxels: columns along -y, then along +x; rows along +z
        along_x, along_y = 6.0 * truth.sum(axis=0)[::-1].T, 6.0 * truth.sum(axis=1).T
        radon = found["radon/6"], found["radon/8"]
        for image, sums in ((radon[0][0], along_x), (radon[1][0], along_x), (radon[1][4], along_y)):
            np.testing.assert_allclose(image, sums, rtol=1e-5, atol=1e-5 * sums.max())


def test_half_precision_errs_by_no_more_than_it_says(small, tmp_path):
    half = events.make(small_recipe(tmp_path, HALF), tmp_path / "set", 2)
    for exact, rounded in zip(small, half, strict=True):
        exact_values = stored(exact)
        with h5py.File(rounded.path, "r") as file:
            for name in ("truth", "images/lines", "images/emission", "radon/6", "radon/8"):
                values, dataset = exact_values[name].astype(np.float64), file[name]
                assert dataset.dtype == np.float16
                scale, error = dataset.attrs["scale"], dataset.attrs["error"]
                assert np.frexp(scale)[0] == 0.5  # a power of 2: no digits are lost by it
                difference = np.abs(dataset[()].astype(np.float64) * scale - values)
                assert difference.max() == pytest.approx(error, rel=1e-6)
                normal = np.abs(values) >= 2.0**-14 * scale
                assert np.all(difference[normal] <= 2.0**-11 * np.abs(values[normal]))
                assert np.all(difference[~normal] <= 2.0**-25 * scale)


@pytest.mark.parametrize("below", [0.0, 0.3])
def test_a_sparse_truth_errs_by_no_more_than_it_says(small, tmp_path, below):
    made = events.make(small_recipe(tmp_path, sparse(below)), tmp_path / "set", 2)
    for exact, kept in zip(small, made, strict=True):
        whole, part = exact.truth.array, kept.truth.array
        expected = np.where(np.abs(whole) > below * whole.max(), whole, 0)
        np.testing.assert_array_equal(part, expected)
        with h5py.File(kept.path, "r") as file:
            attributes = dict(file["truth_values"].attrs)
            index, values = file["truth_index"][()], file["truth_values"][()]
        assert attributes["error"] == np.abs(whole - expected).max()
        by_hand = np.zeros(np.prod(attributes["shape"]), np.float32)
        by_hand[index] = values
        np.testing.assert_array_equal(by_hand.reshape(attributes["shape"]), expected)


def test_every_changed_byte_is_noticed(small, tmp_path):
    original = small[0].path.read_bytes()
    path = tmp_path / "event.h5"
    path.write_bytes(original)
    assert event_files.verify(FileLocation(str(path))) == event_files.read_header(FileLocation(str(small[0].path)))
    some = np.random.default_rng(0).integers(HEADER, len(original), 100).tolist()
    for place in (*range(HEADER), *some, len(original) - 1):
        changed = bytearray(original)
        changed[place] ^= 1 + place % 255
        path.write_bytes(changed)
        with pytest.raises(mph.InputError):
            found = event_files.verify(FileLocation(str(path)))
            # the event and the recipe are no less than the rest what a file says of itself: the set knows better
            if (found.event, found.recipe) != (0, small.recipe.fingerprint):
                raise mph.InputError("of another event or recipe")
    for changed in (original[:-1], original + b"\0", original[:100], b""):
        path.write_bytes(changed)
        refused(lambda: event_files.verify(FileLocation(str(path))))


def test_bytes_do_not_depend_on_threads_or_on_what_was_made_before(small):
    recipe, matrices = small.recipe, small[0].views.projection_matrices()
    geometry = {"projection_matrix": (matrices, "pixel"), "number": (small.system.numbers, "1")}
    for threads in (1, 3):
        maker = events.EventMaker(recipe, threads)
        for number in (1, 0, 1):
            packed = event_files.pack(maker.make(number), recipe, geometry, threads)
            assert packed == small[number].path.read_bytes()
