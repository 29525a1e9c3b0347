"""The page for users of DiffDRR: its notebook is made of it, and runs as it stands."""

import importlib.util
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import WORKBOOK, refused

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def maker():
    """Return tools/make_notebook.py, as a module."""
    spec = importlib.util.spec_from_file_location("make_notebook", ROOT / "tools" / "make_notebook.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_notebook_is_made_of_its_page(maker):
    made = maker.notebook(maker.PAGE.read_text(encoding="utf-8"))
    assert maker.NOTEBOOK.read_text(encoding="utf-8") == made, "run: python tools/make_notebook.py"
    code = [cell for cell in json.loads(made)["cells"] if cell["cell_type"] == "code"]
    assert len(code) > 8 and all(not cell["outputs"] for cell in code)


@pytest.mark.long
def test_the_notebook_runs_as_it_stands(maker, tmp_path, monkeypatch):
    """Its cells, one after the other, in a folder with nothing but the workbook; pictures are drawn and not shown."""
    pytest.importorskip("roma", reason="roma is not installed")
    matplotlib = pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    matplotlib.use("agg")
    shutil.copy(WORKBOOK, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    names: dict[str, object] = {"__name__": "__main__"}
    cells = json.loads(maker.NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    with pytest.warns(mph.InputWarning, match="not DiffDRR's CT of a patient"):
        for k, cell in enumerate(cells):
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), f"cell {k}", "exec"), names)
    assert sorted(path.name for path in names["FOLDER"].iterdir()) == ["derenzo.toml", "pt", "set", "slots", "unet"]


@pytest.fixture
def pyplot():
    pytest.importorskip("roma", reason="roma is not installed")
    pytest.importorskip("matplotlib", reason="matplotlib is not installed").use("agg")
    import matplotlib.pyplot

    yield matplotlib.pyplot
    matplotlib.pyplot.close("all")


def test_plot_drr_shows_each_image_as_it_is(pyplot, rng):
    """Of DRR (B, C, height, width), of Projector (M, n_v, n_u), or one; on new axes, or on those that are given."""
    import torch

    from mphdrr.core.diffdrr import plot_drr

    images = rng.random((2, 3, 5, 7), dtype=np.float32)
    axes = pyplot.subplots(2, 1)[1]
    for given, pictures, axs in (
        (torch.tensor(images, requires_grad=True), images.sum(1), None),
        (images[:, :1], images[:, 0], axes),
        (images[0], images[0], None),
        (images[0, 0], images[:1, 0], axes[0]),
    ):
        shown = plot_drr(given, "a title", axs=axs, vmin=0.0)
        assert len(shown) == len(pictures)
        for ax, picture in zip(shown, pictures, strict=True):
            np.testing.assert_allclose(ax.images[-1].get_array(), picture, rtol=1e-6)
            assert ax.get_xlabel() == "a title"
            assert ax.get_xticks().tolist() == [0, 6] and ax.get_yticks().tolist() == [0, 4]
    assert not len(plot_drr(images[0, 0], ticks=False)[0].get_xticks())
    refused(lambda: plot_drr(images[0, 0, :, 0]), "B x C x height x width, got 5")
    refused(lambda: plot_drr(images[0], axs=axes), "3 images, but 2 axes")


def test_without_matplotlib_it_is_said(monkeypatch):
    pytest.importorskip("roma", reason="roma is not installed")
    from mphdrr.core.diffdrr import plot_drr

    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    refused(lambda: plot_drr(np.zeros((3, 3))), "plot_drr: matplotlib is missing: pip install matplotlib")


def test_a_subject_is_volume_and_spacing_as_before_04(rng):
    pytest.importorskip("roma", reason="roma is not installed")
    import mphdrr.core as mph
    from mphdrr.core.diffdrr import read

    hu = rng.uniform(-900, 900, (4, 5, 6)).astype(np.float32)
    volume, spacing = read(mph.Volume(hu, mph.Grid.centered(hu.shape, (1.5, 2.0, 2.5)), "hu"))
    np.testing.assert_array_equal(volume, hu)
    assert spacing == [1.5, 2.0, 2.5]
