"""The contact sheet of an event set: it says and shows what is in the events."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from PIL import Image

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.events.contact_sheet import SheetRow, contact_sheet, draw_sheet
from mphdrr.core.events.event_set import EventSet

from .small_events import small_recipe


@pytest.fixture(scope="module")
def events(tmp_path_factory) -> EventSet:
    folder = tmp_path_factory.mktemp("sheet")
    return mph.events.make(small_recipe(folder), folder / "set", 4)


def texts(page, folder) -> list[str]:
    page.write(folder / "sheet.svg")
    return re.findall(r"<text [^>]*>([^<]*)<", (folder / "sheet.svg").read_text(encoding="utf-8"))


def shown(truth: np.ndarray, **more) -> SheetRow:
    return SheetRow("Event 0", "", mph.Volume(truth, mph.Grid.centered(truth.shape, 2.0)), np.zeros(3), **more)


def test_the_sheet_says_what_the_events_are(events, tmp_path):
    said = texts(contact_sheet(list(events), "emission", "my set", "4 events"), tmp_path)
    assert {"my set", "4 events"} <= set(said)
    for event in events:
        (title,) = (text for text in said if text.startswith(f"Event {event.number} "))
        assert event.name in title and event.split in title
    x, y, z = (f"{value + 0:.4g}".replace("-", "−") for value in np.round(events[0].position, 1))
    assert any(f"({x}, {y}, {z}) mm" in text for text in said)
    assert sum(text.startswith("emission: 8 views, 0 to ") and text.endswith(" counts") for text in said) == 4
    assert sum(text.startswith("Radon, 8 angles, 0 to ") for text in said) == 4


def test_another_model_is_shown_in_its_unit(events, tmp_path):
    assert any(text.startswith("lines: 8 views") for text in texts(contact_sheet([events[0]]), tmp_path))
    with pytest.raises(mph.InputError, match="none"):
        contact_sheet([events[0]], "none")


def test_slices_show_the_truth_upright():
    """A voxel at +x, +y, +z of the middle lies to the right of and above the middle of each slice through it."""
    truth = np.zeros((32, 32, 32), np.float32)
    truth[16, 16, 16] = 1.0
    truth[24:28, 24:28, 15:18] = 1.0  # in the slice across z, right and above
    picture = draw_sheet([shown(truth)]).picture.astype(int).sum(axis=2)
    bright = np.argwhere(picture > 650)
    side = 320
    top, left = picture.shape[0] - 50 - side, 44
    inside = bright[(bright[:, 0] > top + 14) & (bright[:, 0] < top + side - 40) & (bright[:, 1] > left + 14)]
    inside = inside[inside[:, 1] < left + side - 14]
    block = inside[inside[:, 1] > left + 0.6 * side]
    np.testing.assert_allclose((block.mean(axis=0) - [top, left]) / side, [1 - 26 / 32, 26 / 32], atol=0.02)


def test_a_row_without_images_or_radon_has_slices_alone(tmp_path):
    page = draw_sheet([shown(np.ones((8, 8, 16), np.float32))])
    assert not any("views" in text or "Radon" in text for text in texts(page, tmp_path))
    with_images = draw_sheet([shown(np.ones((8, 8, 16), np.float32), model="m", images=np.ones((3, 4, 5), np.float32),
                               rings=np.zeros(3, np.int64), unit="counts")])  # fmt: skip
    assert with_images.width > page.width


def test_an_empty_event_can_be_draw_sheet():
    nothing = np.zeros((4, 4, 4), np.float32)
    draw_sheet(
        [shown(nothing, model="m", images=np.zeros((2, 4, 4), np.float32), rings=np.zeros(2, np.int64), radon=nothing)]
    )


@pytest.mark.parametrize("count", [0, 200])
def test_too_few_and_too_many_events_are_refused(count):
    with pytest.raises(mph.InputError, match="contact sheet: expected 1 to"):
        draw_sheet([shown(np.ones((4, 4, 4), np.float32))] * count)


def test_the_command_draws_and_lists(events, tmp_path, capsys):
    folder = str(events[0].path.parents[1])
    assert main(["events", "show", folder, "-o", str(tmp_path / "s.png"), "--events", "1", "3"]) == 0
    with Image.open(tmp_path / "s.png") as two, Image.open(tmp_path / "s.png") as again:
        assert two.size == again.size
        height = two.height
    assert main(["events", "show", folder, "-o", str(tmp_path / "s.png")]) == 0
    with Image.open(tmp_path / "s.png") as four:
        assert four.height > 1.7 * height
    capsys.readouterr()
    assert main(["events", "show", folder, "--json"]) == 0
    assert [row["event"] for row in json.loads(capsys.readouterr().out)] == [0, 1, 2, 3]
    assert main(["events", "show", folder]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 5


def test_wrong_calls_of_the_command_are_refused(events, tmp_path, capsys):
    folder = str(events[0].path.parents[1])
    for options, said in (
        (["--events", "9"], "no such event"),
        (["--model", "emission"], "give -o FILE"),
        (["-o", str(tmp_path / "s.jpg")], ".png, .svg"),
        (["--model", "none", "-o", str(tmp_path / "s.png")], "none"),
    ):
        assert main(["events", "show", folder, *options]) == 1
        assert said in capsys.readouterr().err
    assert not list(tmp_path.glob("s.*"))


def test_line_integrals_of_attenuation_have_no_unit(tmp_path):
    mu = mph.Volume(np.full((4, 4, 4), 0.02, np.float32), mph.Grid.centered(4, 5.0), "mu")
    said = texts(draw_sheet([SheetRow("Event 0", "", mu, np.zeros(3), radon=np.full((2, 4, 4), 0.4))]), tmp_path)
    assert "Truth, 0 to 0.02 1/mm" in said and "Radon, 2 angles, 0 to 0.4" in said
