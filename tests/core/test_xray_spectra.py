"""X-ray tubes: half-value layers, mean energies and air kerma of the reference; standard radiation qualities."""

import functools
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics import mass_attenuation, materials
from mphdrr.core.xray import coefficients
from mphdrr.core.xray.coefficients import energy_absorption, interpolate_log
from mphdrr.core.xray.system import filter_thicknesses

from .conftest import refused

REFERENCES = Path(__file__).with_name("data") / "tube_references.txt"
"""Made by tools/tube_references.py: kVp, twice four of SpekPy's numbers, filters."""


def numbers_of(tube):
    """Return first and second half-value layer, mm Al, mean energy, keV, and air kerma, µGy/mAs."""
    first = tube.half_value_layer("Al")
    return [first, tube.value_layer("Al", 0.25) - first, tube.mean_energy, tube.kerma]


def references():
    """Yield kVp, SpekPy's numbers with its own coefficients, those with NIST's, and the filters."""
    for line in REFERENCES.read_text(encoding="ascii").splitlines():
        if not line.startswith("#"):
            kvp, *numbers, filters = line.split(" ", 9)
            own, nist = np.reshape([float(number) for number in numbers], (2, 4))
            yield float(kvp), own, nist, filters


@pytest.mark.parametrize(
    ("kvp", "layer", "energy", "kerma"),
    # SpekPy 2.5 with its own attenuation data (PENELOPE), 1 m, 2.5 mm Al, 12 degrees.
    [(80, 2.734, 42.90, 81.97), (120, 4.220, 54.45, 158.7), (140, 4.990, 59.15, 200.9), (81, 2.7704, 43.265, 83.784)],
)
def test_spectra_are_those_of_spekpy(kvp, layer, energy, kerma):
    tube = mph.tube_spectrum(kvp)
    assert tube.half_value_layer("Al") == pytest.approx(layer, rel=0.01)
    assert tube.mean_energy == pytest.approx(energy, rel=0.01)
    assert tube.kerma == pytest.approx(kerma, rel=0.01)
    assert tube.energies[-1] < kvp < tube.energies[-1] + 1


@pytest.mark.parametrize(
    # IEC 61267:2005, RQR 2, 5, 9, 10: kV, first half-value layer, mm Al, and the ratio of the first to the second. Filters
    # are what the standard lets a laboratory choose; these, all of aluminum, are SpekPy's for the first half-value layer.
    ("kvp", "filter", "layer", "homogeneity"),
    [(40, 2.627, 1.42, 0.81), (70, 2.848, 2.58, 0.71), (120, 3.531, 5.00, 0.68), (150, 4.059, 6.57, 0.72)],
)
def test_standard_radiation_qualities_have_their_two_half_value_layers(kvp, filter, layer, homogeneity):
    tube = mph.tube_spectrum(kvp, {"Al": filter})
    first = tube.half_value_layer("Al")
    assert first == pytest.approx(layer, rel=0.03)
    assert first / (tube.value_layer("Al", 0.25) - first) == pytest.approx(homogeneity, rel=0.03)


@functools.cache
def straight_lines(symbol, energy):
    """Interpolate the coefficients of an element as SpekPy does: by straight lines in the logarithms between all points."""
    points, edges = mass_attenuation.table()[symbol]
    both_sides = [point for edge, below, above in edges for point in ((edge, below), (edge * (1 + 1e-9), above))]
    return float(np.exp(np.interp(np.log(energy), *np.log(sorted([*points, *both_sides])).T)))


def test_soft_and_hard_beams_behind_any_filter_are_spekpys(monkeypatch):
    """With NIST's coefficients all are; with SpekPy's own, which differ, those behind aluminum and a window of beryllium."""
    for kvp, own, nist, filters in references():
        numbers = np.array(numbers_of(mph.tube_spectrum(kvp, filter_thicknesses(filters))))
        is_by_line = (kvp, filters) in (
            (50, "Cu 0.1"),
            (80, "Sn 1"),
            (150, "Al 0.1"),
        )  # where straight lines matter most
        assert np.abs(numbers / nist - 1).max() < (0.019 if is_by_line else 0.015), (kvp, filters)
        if kvp >= 35 and filters in ("Al 0.3", "Al 0.5", "Al 1", "Al 3", "Be 3"):
            assert np.abs(numbers / own - 1).max() < 0.015, (kvp, filters)
    for module in (materials, coefficients):
        monkeypatch.setattr(module, "mass_attenuation", straight_lines)
    monkeypatch.setattr(coefficients, "_attenuations", coefficients._attenuations.__wrapped__)
    for kvp, _, nist, filters in references():
        numbers = numbers_of(mph.tube_spectrum(kvp, filter_thicknesses(filters)))
        assert numbers == pytest.approx(nist, rel=3e-3), (kvp, filters)


def test_the_stored_numbers_are_spekpys():
    pytest.importorskip("spekpy")
    script = Path(__file__).parents[2] / "tools" / "tube_references.py"
    module = importlib.util.module_from_spec(spec := importlib.util.spec_from_file_location("tube_references", script))
    spec.loader.exec_module(module)
    for kvp, own, nist, filters in list(references())[::25]:
        for source, stored in (("pene", own), ("nist", nist)):
            assert module.values(kvp, filters, source) == pytest.approx(stored, rel=1e-3)


def test_what_is_negligible_of_soft_photons_is_left_out():
    """Behind 2.5 mm of aluminum nothing below 10 keV is left; behind 0.3 mm most of it matters."""
    assert mph.tube_spectrum(120).energies[0] == 10.25 and mph.tube_spectrum(120, {"Al": 0.3}).energies[0] < 6
    assert mph.tube_spectrum(30, {}).energies[0] == 1.25 and mph.tube_spectrum(30, {}, angle=12).photons.min() > 0
    one = mph.Spectrum([5.0], [1e5]).filtered({"Al": 1})
    assert one.energies == [5.0]
    m = mph.SpectralTransmission(None, mph.tube_spectrum(100, {}), ("water",), ((20, 100),))
    assert m.spectrum.energies[0] == 20.25 and m.weights.shape == (1, 160)


def test_a_half_value_layer_halves_the_kerma():
    tube = mph.tube_spectrum(100, {"Al": 3, "Cu": 0.1})
    assert tube.filtered({"copper": tube.half_value_layer("Cu")}).kerma == pytest.approx(tube.kerma / 2, rel=1e-9)
    one = mph.Spectrum([60], [1e5])
    assert one.half_value_layer("Al") == pytest.approx(np.log(2) / mph.attenuation("aluminum", 60), rel=1e-9)
    # 60 keV: 1e5 photons/mm^2 = 1e7 /cm^2, 0.03041 cm^2/g: 1e7 x 60 keV x 1.602e-16 J x 0.03041 / 1e-3 kg.
    assert one.kerma == pytest.approx(1e7 * 60 * 1.602177e-16 * 0.03041 / 1e-3 * 1e6, rel=1e-6)


def test_filters_multiply_and_coarser_steps_keep_photons_and_energy():
    tube = mph.tube_spectrum(120, {})
    both = tube.filtered({"Al": 1.5}).filtered({"Al": 1.0})
    np.testing.assert_allclose(both.photons, mph.tube_spectrum(120).photons, rtol=1e-12)
    coarse = both.coarser(2)
    assert len(coarse.energies) == len(both.energies) / 4
    assert coarse.photons.sum() == pytest.approx(both.photons.sum())
    assert coarse.mean_energy == pytest.approx(both.mean_energy)
    assert coarse.kerma == pytest.approx(both.kerma, rel=2e-3)


def test_between_the_energies_of_a_table_coefficients_follow_power_laws():
    assert energy_absorption("air", np.array([80.0, 1000.0])) == pytest.approx([0.02407, 0.02789])
    known = np.array([10.0, 15, 20, 30, 40, 60, 100])
    energies = np.array([10.0, 12, 17, 25, 59, 61, 99])
    np.testing.assert_allclose(interpolate_log(energies, known, 7 * known**-3.0), 7 * energies**-3.0, rtol=1e-12)


def test_what_is_no_spectrum_is_refused_in_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "spekpy", None)
    energies = np.array([10.0, 100.0])
    for call, words in (
        (lambda: mph.tube_spectrum(19), "kvp: expected 20 to 150 kV, got 19"),
        (lambda: mph.tube_spectrum(151), "kvp: expected 20 to 150 kV, got 151"),
        (lambda: mph.tube_spectrum(80, angle=95), "angle: expected less than 90 degrees, got 95"),
        (lambda: mph.tube_spectrum(80, angle=10), "angle: expected 12 degrees, or SpekPy for 10: spekpy is missing"),
        (lambda: mph.tube_spectrum(80, {"Al": -1}), "filters: Al: expected 0 or more mm, got -1"),
        (lambda: mph.tube_spectrum(80, {"cheese": 1}), "filters: material 'cheese': expected one of"),
        (lambda: mph.Spectrum([60, 50], [1, 1]), "spectrum: energies: expected one or more, ascending"),
        (
            lambda: mph.Spectrum([0.5, 60], [1, 1]),
            "spectrum: energies: expected one or more, ascending, from 1 to 1000 keV",
        ),
        (lambda: mph.Spectrum([50, 60], [0, 0]), "spectrum: photons: expected none below 0, and some above"),
        (lambda: mph.tube_spectrum(80).value_layer("Al", 1.0), "share: expected between 0 and 1, got 1"),
        (lambda: interpolate_log(energies * 0.9, energies, energies), "energies 9 to 90 keV: expected 10 to 100 keV"),
    ):
        refused(call, words)
