"""Colours of numbers, and the mosaic with its numbers and colour bar."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from PIL import Image

import mphdrr.core as mph
from mphdrr.core.runs.display import COLORS, SCALES, Display, number_text
from mphdrr.core.runs.letters import text_ink, width, wrap_text
from mphdrr.core.runs.mosaic import draw_sheet, image_totals, sheet_columns, tile_places, write_png

from .conftest import refused

numbers = st.lists(st.floats(-1e6, 1e6, width=32), min_size=2, max_size=30)


@example([0.0, 1.4909815660416054e-41], "log", "inferno")
@given(numbers, st.sampled_from(SCALES), st.sampled_from(COLORS))
def test_larger_numbers_never_have_a_lower_colour_and_the_ends_are_the_windows(values, scale, colors):
    display, values = Display(colors, scale), np.sort(np.float32(values))
    low, high = display.window(values)
    shares = display.shares(values, (low, high))
    assert np.all(np.diff(shares) >= 0) and shares.min() >= 0 and shares.max() <= 1
    assert high == values.max() and low <= high
    if low < high:
        first, last = Display(colors).colored([0.0, 1.0])
        np.testing.assert_array_equal(display.colored([low, high], (low, high)), [first, last])


@pytest.mark.parametrize("scale", SCALES)
def test_the_bar_says_the_number_that_has_its_colour(scale):
    display, window = Display(scale=scale, low=2.0, high=300.0), (2.0, 300.0)
    for share in np.linspace(0, 1, 7):
        assert display.shares(display.value_at(share, window), window) == pytest.approx(share, abs=1e-6)


@pytest.mark.parametrize(
    ("scale", "window", "marks"),
    [
        ("linear", (0.0, 1.93), [0, 0.5, 1, 1.5]),
        ("sqrt", (0.0, 38.6), [0, 10, 20, 30]),
        ("linear", (-0.2, 0.2), [-0.2, -0.1, 0, 0.1, 0.2]),
        ("log", (0.9, 1000.0), [1, 10, 100, 1000]),
        ("log", (2.0, 7.0), [2, 3, 4, 5, 6, 7]),
        ("linear", (3.0, 3.0), [3]),
    ],
)
def test_marks_of_a_bar_are_round_numbers_in_its_window(scale, window, marks):
    found = Display(scale=scale).marks(window)
    np.testing.assert_allclose(found, marks, atol=1e-12)
    assert "-0" not in [f"{mark:.4g}" for mark in found]


def test_numbers_outside_a_window_have_its_ends_colours_and_no_number_has_the_first():
    display = Display("grey", low=1.0, high=2.0)
    np.testing.assert_array_equal(display.colored([0.0, 1.5, 9.0, np.nan])[:, 0], [0, 128, 255, 0])
    assert Display().window([[np.nan, 3.0], [np.inf, -1.0]]) == (-1.0, 3.0)
    assert Display(scale="log").window([5.0, 2000.0]) == (2.0, 2000.0)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"colors": "jet"}, "colors 'jet': expected one of inferno"),
        ({"scale": "cube"}, "scale 'cube': expected one of linear"),
        ({"region": "all"}, "region 'all': expected one of object, half, whole"),
        ({"low": 3, "high": 3}, "expected low to be less than high"),
        ({"scale": "log", "low": 0}, "expected more than 0 on the logarithmic scale"),
        ({"high": np.inf}, "expected a finite number"),
    ],
)
def test_displays_that_cannot_be(settings, said):
    refused(lambda: Display(**settings), said)


@pytest.mark.parametrize(("shape", "factor"), [((100, 96), 1.0), ((20, 30), 4.0), ((200, 160), 0.5)])
def test_every_image_stands_in_its_rings_row_as_the_pinhole_sees_it(shape, factor):
    rings = np.repeat([0, 1], [3, 5])
    images = np.random.default_rng(2).random((8, *shape), np.float32) * 70
    drawn = draw_sheet(images, np.arange(1, 9), rings, "counts", pixels=8 * 110 * 90)
    assert drawn.window == (0.0, images.max()), "the bar's upper end is the largest exact number"
    assert drawn.tile == (shape[0] * factor, shape[1] * factor)
    rows, columns = drawn.corners.T
    assert len(set(rows[:3])) == len(set(rows[3:])) == 1 and rows[0] < rows[3]
    assert list(columns[:3]) == list(columns[3:6]) == sorted(columns[:3])
    for m, (row, column) in enumerate(drawn.corners):
        own = drawn.picture[row : row + drawn.tile[0], column : column + drawn.tile[1]]
        between = drawn.picture[row - 1, column : column + drawn.tile[1]]
        assert np.all(between == between[0]), "the images do not touch"
        if factor == 1:  # all but the number and the total in the corners
            wanted = Display().colored(mph.as_seen(images[m]), drawn.window)
            np.testing.assert_array_equal(own[26:-24], wanted[26:-24])


@pytest.mark.parametrize("rings", [[24], [1], [10], [23], [80], [100], [360], [20, 20, 20, 20], [30, 30], [41, 7]])
def test_a_sheet_has_the_shape_of_a_page_or_a_row_for_each_ring(rings):
    columns = sheet_columns(np.repeat(np.arange(len(rings)), rings))
    tiles = tile_places(np.repeat(np.arange(len(rings)), rings), columns)
    assert len(set(map(tuple, tiles))) == sum(rings) and columns == tiles[:, 1].max() + 1, "no column is empty"
    rows = int(tiles[:, 0].max()) + 1
    if len(rings) > 1:
        assert columns <= 20 and rows == sum(-(-n // 20) for n in rings)
    elif any(sum(rings) % k == 0 and k * k <= sum(rings) <= 2.5 * k * k for k in range(1, 21)):
        assert rows * columns == sum(rings) and rows <= columns <= 2.5 * rows, "no tile is empty"
    else:
        assert rows * columns - sum(rings) < columns and 0.9 * rows <= columns <= 2.5 * rows
    assert rings != [24] or (rows, columns) == (4, 6)


@pytest.mark.parametrize(
    ("value", "text"),
    [(-0.0, "0"), (0.25, "0.25"), (-3.0, "−3"), (16384, "16380"), (1e5, "10⁵"), (-1e7, "−10⁷"), (3.349e11, "3.349 × 10¹¹"),
     (2.5e-7, "2.5 × 10⁻⁷"), (np.inf, "inf")],
)  # fmt: skip
def test_numbers_are_written_as_people_write_them(value, text):
    assert number_text(value) == text
    unknown = text_ink("?", 48)[0]
    assert not any(np.array_equal(text_ink(letter, 48)[0], unknown) for letter in text)


def has_ink(picture, text, size):
    """Return whether a text stands somewhere in a picture, in white on something dark."""
    ink, _ = text_ink(text, size)
    windows = np.lib.stride_tricks.sliding_window_view(picture.min(axis=2), ink.shape)
    return bool(((windows[..., ink > 0.9] > 220).all(axis=-1) & (windows[..., ink < 0.2] < 160).all(axis=-1)).any())


@pytest.mark.parametrize("unit", ["counts", "photons", "kBq/mL mm", "1"])
def test_every_image_has_its_sum_or_mean_and_the_bar_round_numbers(unit):
    images = 2 * np.random.default_rng(3).random((3, 128, 128), np.float32)
    word, values = image_totals(images, unit)
    assert word == ("sum" if unit in ("counts", "photons") else "mean")
    np.testing.assert_allclose(values, [getattr(image.astype(float), word)() for image in images], rtol=1e-12)
    size = 128 / 5
    assert 1.9 < images.max() < 2.0
    # In several rows the tiles have numbers alone, larger, and the word stands below the colour bar.
    for rings, prefix, legend in (([0, 0, 0], f"{word} ", ""), ([0, 0, 1], "", f"tile: {word}")):
        drawn = draw_sheet(images, [1, 2, 3], rings, unit)
        texts = [f"{prefix}{number_text(value)}" for value in values]
        small = min(size, 128 / max(width(text, 1.05) for text in texts))
        for (row, column), text in zip(drawn.corners, texts, strict=True):
            assert has_ink(drawn.picture[row : row + 128, column : column + 128], text, small)
        bar = drawn.picture[:, drawn.corners[:, 1].max() + 128 :]
        assert all(has_ink(bar, text, 0.9 * size) for text in ("0", "1", *filter(None, [legend])))
        assert not has_ink(bar, "9.9", 0.9 * size)


@pytest.mark.parametrize("shape", [(128, 128), (101, 126)])
def test_the_central_half_is_shown_with_its_own_totals_in_the_window_of_all(shape):
    images = np.random.default_rng(4).random((2, *shape), np.float32)
    images[0, 0, 0] = 50.0
    n_v, n_u = shape
    middle = images[:, n_v // 4 : n_v - n_v // 4, n_u // 4 : n_u - n_u // 4]
    display = Display(region="half")
    assert np.array_equal(display.part(images), middle)
    assert np.array_equal(display.part(images[:, ::-1, ::-1]), middle[:, ::-1, ::-1]), "seen from any side"
    drawn, own = draw_sheet(images, [1, 2], [0, 0], "counts", display), Display(high=50.0)
    assert drawn.window == (0.0, 50.0), "the largest of all exact numbers"
    expected = draw_sheet(middle, [1, 2], [0, 0], "counts", own).picture
    np.testing.assert_array_equal(drawn.picture[:, :-200], expected[:, :-200])
    np.testing.assert_allclose(drawn.totals, middle.sum(axis=(1, 2), dtype=float))


@pytest.mark.parametrize(
    ("size", "reach", "eighths"), [(64, 8, 3), (64, 15, 4), (128, 33, 5), (50, 24, 8), (64, 31, 8)]
)
def test_the_object_fills_the_tiles_and_is_whole_in_all_of_them(size, reach, eighths):
    """The object, of 1, reaches so many pixels from the middle in one of the images; the faint ground does not count."""
    rng = np.random.default_rng(6)
    images = rng.poisson(0.001, (3, size, size)).astype(np.float32) / 10
    images[:, size // 2 - 4 : size // 2 + 4, size // 2 - 4 : size // 2 + 4] = 1.0
    images[1, size // 2 - reach : size // 2, size // 2 - 3 : size // 2 + 3] = 1.0
    shown = Display(region="object").part(images, in_mosaic=True)
    cut = size * (8 - eighths) // 16
    assert np.array_equal(shown, images[:, cut : size - cut, cut : size - cut])
    drawn, whole = (
        draw_sheet(images, [1, 2, 3], [0] * 3, "counts", Display(region="object")),
        draw_sheet(images, [1, 2, 3], [0] * 3, "counts"),
    )
    np.testing.assert_array_equal(drawn.totals, whole.totals)
    assert drawn.window == whole.window and drawn.share == (1 - 2 * cut / size,) * 2 and not drawn.half


@pytest.mark.parametrize("value", [0.0, 1.0, np.nan])
def test_images_without_an_object_are_shown_whole(value):
    images = np.full((2, 30, 40), value, np.float32)
    assert Display(region="object").part(images, in_mosaic=True).shape == images.shape


def test_a_unit_of_length_stays_with_its_number():
    lines = wrap_text("CGLS, 3 iterations, 128 x 128 x 128 voxels of 1.17 mm", lambda text: len(text) <= 50)
    assert lines == ["CGLS, 3 iterations, 128 x 128 x 128 voxels of", "1.17 mm"]
    assert wrap_text("", lambda text: False) == [""]


def test_images_too_small_for_a_total_have_none():
    images = np.zeros((2, 24, 100), np.float32)
    images[0, 20, 20] = 123456.0
    drawn = draw_sheet(images, [1, 2], [0, 0], "counts")
    (row, column) = drawn.corners[1]
    assert not (drawn.picture[row + 16 : row + 24, column : column + 100] == 255).any()


def test_a_run_without_counts_can_be_shown(tmp_path):
    drawn = draw_sheet(np.zeros((1, 8, 8), np.float32), [1], [0], "counts", Display(scale="log"))
    write_png(drawn.picture, tmp_path / "a.png")
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "a.png")), drawn.picture)


def test_letters_are_told_apart():
    pictures = {text: text_ink(text, 11)[0].tobytes() for text in "0123456789.-+ekBqmLcounts/"}
    assert len(set(pictures.values())) == len(pictures)
    unknown, question = (text_ink(text, 20)[0] for text in "€?")
    np.testing.assert_array_equal(unknown, question)
