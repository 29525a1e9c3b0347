"""Coefficients of materials: published values, absorption edges; and materials by name in the model of counts."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics.mass_attenuation import table
from mphdrr.core.physics.materials import APERTURES, CRYSTALS, CZT_MU, LEAD_MU, NAI_MU, TUNGSTEN_MU, WATER_MU

TC, TL = 140.5, 70.8


@pytest.mark.parametrize(
    ("material", "energy", "expected"),
    [
        # Between the table's energies, and on either side of K edges: density times the elements' coefficients of Elam
        # et al. (2002) as in XrayDB 4, 1/mm.
        *(("tungsten", *point) for point in ((25, 70.6), (68.9, 5.038), (70.8, 20.68), (120, 5.379), (364.5, 0.4346))),
        *(("lead", *point) for point in ((70.8, 3.732), (87.5, 2.198), (88.5, 8.596), (TC, 2.689), (364.5, 0.312))),
        *(("gold", *point) for point in ((80.3, 4.183), (81.2, 16.94), (TC, 4.229), (245.4, 1.111))),
        *(("uranium", *point) for point in ((22.5, 160.6), (115, 2.643), (116.5, 9.098), (171.3, 3.56), (511, 0.3614))),
        *(("NaI", *point) for point in ((33, 2.097), (33.4, 10.97), (TL, 1.523), (159, 0.1963), (511, 0.03423))),
        *(("CsI", *point) for point in ((33, 3.164), (34.5, 8.644), (36.2, 13.44), (TC, 0.3854))),
        *(("CZT", *point) for point in ((26.5, 5.947), (27, 15.77), (31.7, 10.42), (32, 19.57), (TL, 2.384))),
        *(("LYSO", *point) for point in ((62.9, 1.608), (63.8, 6.615), (511, 0.08184))),
        *(("BGO", *point) for point in ((90, 1.007), (91.2, 3.569), (511, 0.09629))),
        *(("GAGG", *point) for point in ((49.9, 1.816), (50.6, 6.661), (TC, 0.5015))),
        *(("water", *point) for point in ((25, 0.05082), (70, 0.019285), (140, 0.015383), (511, 0.009599))),
        *(("bone", *point) for point in ((25, 0.4144), (70, 0.04935), (TC, 0.02931), (511, 0.01716))),
        ("air", 120, 1.7525e-5),
        ("muscle", TL, 0.02003),
        ("adipose tissue", TL, 0.01775),
        # At Tc-99m's energy: the constants.
        ("tungsten", TC, TUNGSTEN_MU),
        ("lead", TC, LEAD_MU),
        ("NaI", TC, NAI_MU),
        ("CZT", TC, CZT_MU),
        ("water", TC, WATER_MU),
        # Tissues of phantoms: Elam et al. (2002).
        ("soft tissue", TC, 0.0161),
        ("lung", TC, 0.00396),
        ("vertebra", TC, 0.0203),
        ("PMMA", TC, 0.0177),
    ],
)
def test_coefficients_are_the_published_ones(material, energy, expected):
    assert mph.attenuation(material, energy) == pytest.approx(expected, rel=3e-3)


@pytest.mark.parametrize(
    ("material", "points"),
    [  # Below 10 keV, and of filters: density times the coefficients of Elam et al. (2002) as in XrayDB 4.5.8, 1/mm.
        ("beryllium", ((1.25, 57.42), (5.25, 0.6962), (25, 0.03592), (70, 0.02667))),
        ("aluminum", ((1.25, 176.4), (2.75, 269.1), (9, 9.633), (17, 1.488))),
        ("copper", ((3.25, 541.7), (8.7, 37.4), (9.3, 229.8), (25, 16.31))),
        ("tin", ((3.7, 264.8), (6.8, 279.2), (29, 5.777), (29.5, 31.21), (70, 3.169))),
        ("tungsten", ((1.6, 2769), (2.2, 5971), (2.9, 3970), (9, 244.1))),
        ("water", ((3.5, 12.279),)),
    ],
)
def test_soft_coefficients_and_those_of_filters_are_the_published_ones(material, points):
    for energy, expected in points:
        assert mph.attenuation(material, energy) == pytest.approx(expected, rel=1e-2)


def test_coefficients_fall_with_energy_and_rise_at_the_edges():
    for name, material in mph.MATERIALS.items():
        edges = [edge for symbol in material.composition for edge, *_ in table()[symbol][1] if edge > 10]
        energies = np.union1d(np.geomspace(10, 1000, 50), [*edges, *np.multiply(edges, 1 - 1e-9)])
        rises = energies[1:][np.diff([mph.attenuation(name, energy) for energy in energies]) > 0]
        assert rises == pytest.approx(sorted(edges), rel=1e-12)
        assert sum(material.composition.values()) == pytest.approx(1, abs=2e-5)
    # K edges of J. A. Bearden, A. F. Burr, Reviews of Modern Physics 39 (1967) 125-142, keV: both sides by NIST,
    # cm^2/g.
    for name, edge, below, above in (
        ("tungsten", 69.525, 2.552, 11.23),
        ("lead", 88.0045, 1.910, 7.683),
        ("gold", 80.7249, 2.137, 8.904),
        ("uranium", 115.606, 1.378, 4.893),
    ):
        found = [mph.attenuation(name, edge * x) for x in (1 - 1e-9, 1, 1 + 1e-9)]
        assert found == pytest.approx(mph.MATERIALS[name].density / 10 * np.array([below, above, above]), rel=1e-6)


def test_shares_of_the_mass_are_those_of_the_formulas():
    # Standard atomic weights, IUPAC 2021.
    weights = {
        "Na": 22.990, "I": 126.90, "Cs": 132.91, "Cd": 112.41, "Zn": 65.38, "Te": 127.60, "Bi": 208.98, "Ge": 72.630,
        "O": 15.999, "Lu": 174.97, "Y": 88.906, "Si": 28.085, "Gd": 157.25, "Al": 26.982, "Ga": 69.723,
    }  # fmt: skip
    formulas = {
        "NaI": {"Na": 1, "I": 1},
        "CsI": {"Cs": 1, "I": 1},
        "CZT": {"Cd": 0.9, "Zn": 0.1, "Te": 1},
        "CdTe": {"Cd": 1, "Te": 1},
        "BGO": {"Bi": 4, "Ge": 3, "O": 12},
        "LYSO": {"Lu": 1.8, "Y": 0.2, "Si": 1, "O": 5},
        "GAGG": {"Gd": 3, "Al": 2, "Ga": 3, "O": 12},
    }
    assert set(formulas) == set(CRYSTALS)
    for name, formula in formulas.items():
        masses = {symbol: count * weights[symbol] for symbol, count in formula.items()}
        shares = {symbol: mass / sum(masses.values()) for symbol, mass in masses.items()}
        assert mph.MATERIALS[name].composition == pytest.approx(shares, abs=1e-5)


def test_where_compton_scattering_rules_electrons_count():
    """At 140.5 keV the coefficients of light materials are proportional to their electrons per volume."""
    for name, per_gram in (("soft tissue", 0.5500), ("lung", 0.5505), ("PMMA", 0.5394)):
        expected = mph.MATERIALS[name].density * per_gram / 0.5551
        assert mph.attenuation(name, TC) / mph.attenuation("water", TC) == pytest.approx(expected, rel=1e-2)


def test_names_are_told_apart_and_energies_checked():
    assert set(APERTURES + CRYSTALS) < set(mph.MATERIALS)
    assert mph.attenuation("Tungsten", TC) == mph.attenuation("tungsten", TC)
    assert mph.attenuation("nai", TC) == mph.attenuation("NaI", TC)
    assert mph.attenuation("soft-tissue", TC) == mph.attenuation("soft tissue", TC)
    for material in ("kryptonite", "", None, 3.6):
        with pytest.raises(mph.InputError, match=r"material .*: expected one of tungsten, .*, bone"):
            mph.attenuation(material, TC)
    for energy in (0.99, 1001, 0, -1, np.nan, "Tc-99m", None):
        with pytest.raises(mph.InputError, match="energy"):
            mph.attenuation("lead", energy)


@pytest.mark.long
@pytest.mark.parametrize("edge", ["paix", "path"])
def test_a_material_by_name_is_its_coefficient_at_the_isotopes_photons(edge, system, rng):
    grid, views = mph.Grid.centered(6, 12.0), system.views((8, 8))
    activity = rng.random(grid.shape)
    for isotope, window, energy in (("Tc-99m", None, TC), ("I-123", None, 159.0), ("Tl-201", (160, 180), 167.4)):
        settings = {"isotope": isotope, "window": window, "edge": edge, "depth_layers": 2, "aperture_points": 3}
        by_name = mph.Emission(system, aperture_mu="Tungsten", crystal_mu="CZT", pixel_points=1, **settings)
        numbers = {"aperture_mu": mph.attenuation("tungsten", energy), "crystal_mu": mph.attenuation("CZT", energy)}
        by_number = mph.Emission(system, **numbers, pixel_points=1, **settings)
        assert by_name.record() == by_number.record() and by_name.record() | numbers == by_name.record()
        np.testing.assert_array_equal(*(mph.Projector(grid, views, x)(activity) for x in (by_name, by_number)))


def test_several_lines_count_as_they_do_together(system):
    """Tungsten's K edge is between Tl-201's two strongest lines, 68.9 and 70.8 keV; Ga-67's are far apart."""
    system = dataclasses.replace(system[:2], pinhole_diameter=2.3, detector_thickness=10.0, tilt=0.0)
    points = system.principal_rays[0] * np.linspace(-40, 40, 5)[:, None]  # on the axis of module 0
    materials = {"aperture_mu": "tungsten", "crystal_mu": "NaI"}
    for isotope, window in (("Tl-201", None), ("Ga-67", (80, 330))):
        model = mph.Emission(system, isotope=isotope, window=window, **materials)
        lines = model.isotope.lines_within(*model.window)
        assert len(lines) > 1
        apart = 0.0
        for energy, photons in lines:
            numbers = {name: mph.attenuation(material, energy) for name, material in materials.items()}
            apart += mph.sensitivity(system, points, **numbers, photons_per_decay=photons)
        numbers = {name: getattr(model, name) for name in ("aperture_mu", "crystal_mu", "photons_per_decay")}
        together = mph.sensitivity(system, points, **numbers)
        assert together[:, 0] == pytest.approx(apart[:, 0], rel=1e-9) and together[:, 0].min() > 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"aperture_mu": "tungsten"}, "aperture_mu 'tungsten': at which energy"),
        ({"aperture_mu": "tungsen"}, "aperture_mu: material 'tungsen': expected one of"),
        ({"crystal_mu": "NaI", "photons_per_decay": 0.9}, "crystal_mu 'NaI': at which energy"),
        ({"crystal_mu": "NaI", "isotope": "Tc-99m", "window": (1, 2), "photons_per_decay": 0.9}, "in its window"),
        ({"aperture_mu": "wolfram", "isotope": "Tc-99m"}, "aperture_mu: material 'wolfram': expected one of tungsten"),
        ({"crystal_mu": "NaI", "isotope": mph.Isotope("Co-60", 1.7e8, ((1173.2, 1.0),))}, "crystal_mu: energy 1173.2"),
    ],
)
def test_materials_without_an_energy_are_refused(settings, message, system):
    with pytest.raises(mph.InputError, match=message):
        mph.Emission(system, **settings)
