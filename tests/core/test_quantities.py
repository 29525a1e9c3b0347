"""A volume's quantity decides what can be made of it: the same rule in scripts and on the command line."""

from __future__ import annotations

import re

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.errors import InputError
from mphdrr.core.physics.ct_numbers import diffdrr_density
from mphdrr.core.rays.tracing import trace_fans
from mphdrr.core.runs.projecting import project_run
from mphdrr.core.volumes.volume import UNITS
from mphdrr.core.volumes.volume_files import write_volume

GRID = mph.Grid.centered(6, 12.0)
LINES = {"activity", "mu"}
CONVERSION = r"hu_to_mu\(volume, energy\), `mphdrr volume convert FILE --to-mu --energy KEV`, or CT to Attenuation"
SMALL = ["--size", "6", "5", "--modules", "3-4", "--backend", "numpy"]


def volume_of(quantity: str) -> mph.Volume:
    return mph.Volume(np.full(GRID.shape, 0.01), GRID, quantity)


def _trace(volume, mu=None):
    return mph.trace_rays(volume, [0.0, 0.0, -90.0], [0.0, 1.0, 90.0], "numpy", mu=mu)


def _fans(volume, mu=None):
    fan = [[0.0, 0.0, -90.0], [-2.0, -2.0, 90.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    return trace_fans(volume, fan, (3, 4), "numpy", mu=mu)


def _poses(name, **settings):
    def use(volume):
        torch = pytest.importorskip("torch")
        from mphdrr.core.projector import torch_cameras

        position = torch.tensor([0.0, 0.0, -200.0])
        return getattr(torch_cameras, name)(volume, position, torch.eye(3), 60.0, 1.5, (4, 4), **settings)

    return use


def _diffdrr(name, *arguments):
    def use(volume):
        pytest.importorskip("torch")
        from mphdrr.core.exchange import diffdrr

        return getattr(diffdrr, name)(volume, *arguments)

    return use


def _projector(model):
    def use(volume, system):
        views = system.views((5, 6))
        return mph.Projector(GRID, views, model(system), "numpy")(volume)

    return use


def _run(model):
    return lambda volume, system: project_run(system, volume, (5, 6), backend="numpy", model=model(system))


MODELS = {
    "transmission": (lambda system: mph.Transmission(), LINES),
    "emission": (lambda system: mph.Emission(system), {"activity"}),
    "inverse square": (lambda system: mph.InverseSquareSum(system), LINES),
}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(
    ("use", "quantity"), [*((_projector, name) for name in UNITS), (_run, "hu"), (_run, "activity")]
)
def test_a_model_takes_the_quantities_it_has_a_meaning_for(use, model, quantity, system):
    make, taken = MODELS[model]
    project, volume = use(make), volume_of(quantity)
    if quantity in taken:
        project(volume, system)
    else:
        advice = CONVERSION if quantity == "hu" and "mu" in taken else ""
        with pytest.raises(InputError, match=f"expected a volume of activity.*, got {quantity}.*{advice}"):
            project(volume, system)


USES = {
    "trace_rays": (_trace, LINES),
    "trace_rays attenuated": (lambda volume: _trace(volume, volume_of("mu")), {"activity"}),
    "trace_rays, mu": (lambda volume: _trace(volume_of("activity"), volume), {"mu"}),
    "trace_fans": (_fans, LINES),
    "trace_fans attenuated": (lambda volume: _fans(volume, volume_of("mu")), {"activity"}),
    "pinhole_images": (_poses("pinhole_images"), LINES),
    "emission_images": (_poses("emission_images", diameter=2.0), {"activity"}),
    "hu_to_mu": (mph.hu_to_mu, {"hu"}),
    "diffdrr_density": (diffdrr_density, {"hu"}),
    "diffdrr.read": (_diffdrr("read"), {"hu"}),
    "diffdrr.DRR": (_diffdrr("DRR", 240.0, 6, 4.0), LINES),
}


@pytest.mark.filterwarnings("ignore::mphdrr.core.errors.InputWarning")
@pytest.mark.parametrize("quantity", UNITS)
@pytest.mark.parametrize("name", USES)
def test_functions_take_the_quantities_they_have_a_meaning_for(name, quantity):
    use, taken = USES[name]
    if quantity in taken:
        use(volume_of(quantity))
    else:
        with pytest.raises(InputError, match=rf"got {quantity}|CT numbers"):
            use(volume_of(quantity))


def test_what_attenuates_is_mu(system):
    with pytest.raises(InputError, match=f"emission: mu: expected a volume of mu, got hu; .*{CONVERSION}"):
        mph.Emission(system, volume_of("hu"))


def test_arrays_say_no_quantity_and_are_the_callers(system):
    array, views = np.full(GRID.shape, -1000.0), system.views((5, 6))
    expected = -1e5 * mph.Projector(GRID, views, backend="numpy")(volume_of("mu"))
    with pytest.warns(mph.InputWarning, match="100% of its values are those of air in CT numbers"):
        np.testing.assert_allclose(mph.Projector(GRID, views, backend="numpy")(array), expected, rtol=1e-6)
    assert mph.trace_rays(array, [0.0, 0.0, -90.0], [0.0, 1.0, 90.0], grid=GRID) < 0


@pytest.fixture
def ct() -> mph.Volume:
    array = np.full(GRID.shape, -1000.0)
    array[1:5, 1:5, 1:5] = 40.0
    return mph.Volume(array, GRID, "hu")


def _said_nothing(volume: mph.Volume, path) -> None:
    """Write a file as other programs write it."""
    import nibabel

    nibabel.save(nibabel.Nifti1Image(volume.array, volume.grid.affine), path)


def _project(small_workbook, folder, *options) -> int:
    return main(["project", str(small_workbook), *SMALL, *map(str, options), "-o", str(folder / "run.h5")])


@pytest.mark.parametrize(("option", "labelled"), [("--volume", False), ("--states", True)])
def test_ct_numbers_are_no_radiograph_but_converted_they_are(option, labelled, ct, small_workbook, tmp_path, capsys):
    path = tmp_path / "ct.nii.gz"
    (write_volume if labelled else _said_nothing)(ct, path)
    assert _project(small_workbook, tmp_path, option, path) == 1
    said = capsys.readouterr().err
    assert "give --energy KEV to convert" in said and said.count("\n") == 1 and not list(tmp_path.glob("run*"))
    assert _project(small_workbook, tmp_path, option, path, "--energy", "60") == 0
    run = mph.read_run(tmp_path / "run.h5")
    mu = mph.hu_to_mu(ct, 60.0)
    np.testing.assert_allclose(run.volume.array, mu.array, rtol=1e-6)
    np.testing.assert_allclose(run.projections, mph.Projector(GRID, run.views)(mu), rtol=1e-4, atol=1e-6)
    assert run.unit == "1/mm mm" and run.volume.quantity == "mu"


@pytest.mark.parametrize(
    ("quantity", "options", "unit"),
    [("activity", [], "kBq/mL mm"), ("mu", [], "1/mm mm"), ("activity", ["--emission"], "counts")],
)
def test_a_file_that_says_nothing_holds_what_the_user_says(quantity, options, unit, small_workbook, tmp_path):
    _said_nothing(volume_of(quantity), tmp_path / "a.nii")
    assert _project(small_workbook, tmp_path, "--volume", tmp_path / "a.nii", "--quantity", quantity, *options) == 0
    run = mph.read_run(tmp_path / "run.h5")
    assert (run.volume.quantity, run.unit) == (quantity, unit)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--volume", "ct.nii", "--emission"], "as of a CT, are no activity; --quantity activity takes them"),
        (["--volume", "mu.nii", "--quantity", "mu", "--emission"], "emission: expected a volume of activity, got mu"),
        (["--volume", "raw.nii", "--photons", "1000"], "4000 is no attenuation in 1/mm; .* give the energy"),
        (["--emission", "--mu", "raw.nii"], "4000 is no attenuation in 1/mm; .* give the energy"),
        (["--volume", "map.npz"], "expected a volume of activity or mu, got sensitivity"),
        (["--volume", "map.npz", "--emission"], "holds sensitivity, expected activity"),
        (
            ["--volume", "ct.nii", "--quantity", "mu", "--energy", "60"],
            r"\(--quantity\) does not go with volume.energy",
        ),
        (["--quantity", "mu"], r"\(--quantity\) needs volume.file"),
        (["--volume", "mu.nii", "--quantity", "activity", "--photons", "9"], "photons: expected the transmission of"),
    ],
)
def test_what_the_model_cannot_mean_is_refused_in_one_line(
    options, message, ct, small_workbook, tmp_path, capsys, monkeypatch
):
    _said_nothing(ct, tmp_path / "ct.nii")
    _said_nothing(mph.Volume(ct.array + 1000 + 2960 * (ct.array > 0), GRID), tmp_path / "raw.nii")
    _said_nothing(volume_of("mu"), tmp_path / "mu.nii")
    write_volume(volume_of("sensitivity"), tmp_path / "map.npz")
    monkeypatch.chdir(tmp_path)
    assert _project(small_workbook, tmp_path, *options) == 1
    said = capsys.readouterr().err
    assert re.search(message, said) and said.count("\n") == 1 and not (tmp_path / "run.h5").exists()


def test_activity_below_0_is_taken_where_it_is_said_to_be_activity(small_workbook, tmp_path, ct, capsys):
    _said_nothing(ct, tmp_path / "ct.nii")
    options = ["--volume", tmp_path / "ct.nii", "--emission", "--quantity", "activity"]
    assert _project(small_workbook, tmp_path, *options) == 0
    assert "what is below 0 makes counts below 0" in capsys.readouterr().err


@pytest.mark.parametrize(("energy", "said"), [("I-131", False), ("Tc-99m", True)])
def test_attenuation_at_another_energy_than_the_photons_is_said(energy, said, ct, small_workbook, tmp_path, capsys):
    write_volume(ct, tmp_path / "ct.npz")
    write_volume(volume_of("activity"), tmp_path / "a.npz")
    options = ["--volume", tmp_path / "a.npz", "--emission", "--isotope", "I-131", "--mu", tmp_path / "ct.npz"]
    assert _project(small_workbook, tmp_path, *options, "--energy", energy) == 0
    expected = "the mu of ct.npz holds at 140.5 keV, photons of 328.05 to 400.95 keV are counted"
    assert (expected in capsys.readouterr().err) == said
