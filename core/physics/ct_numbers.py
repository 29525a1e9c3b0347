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

from ..errors import InputError, InputWarning
from ..memory import require
from ..validation import freeze, real_array
from ..volumes.volume import Volume, require_quantity, require_volume
from .materials import attenuation

CT_ENERGY = 70.0
"""keV: the one energy at which a patient attenuates about as a CT's beam of 120 kV. Only the slope of bone depends on it.

Spectra calculated with SpekPy 2 (tungsten anode, 6 to 9 mm of aluminium) see bone relative to water as 67 to 72 keV do
behind 20 to 30 cm of water, and as 61 to 63 keV behind 10 cm.
"""

AIR_HU = -1000.0
_PADDING_HU = -1024.0  # below the 12 bits of a CT: what lies outside the scanned circle
_METAL_HU = 3071.0  # above the 12 bits of a CT
_WATER_HU = 5.0  # no CT of anything is as even as that
DIFFDRR_AIR, DIFFDRR_BONE = -800.0, 350.0  # HU, its limits


def hu_to_mu(volume: Volume, energy: float = 140.5, ct_energy: float = CT_ENERGY) -> Volume:
    """Attenuation coefficients, 1/mm, of a volume of CT numbers.

    With w, a, b the coefficients of water, air and cortical bone at `energy`, and W, B those at `ct_energy`::

        HU <= 0:  mu = w + HU / 1000 * (w - a)
        HU >= 0:  mu = w + HU / 1000 * (b - w) * W / (B - W)

    Below -1000 HU is air, too: scanners fill what they do not see with -1024, -2048 or -3024. Metal lies on bone's line.
    An `InputWarning` says so where there is any below -1024 or above 3071 HU, and where all lie within 5 HU of water.

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
    require_volume(volume, "hu_to_mu")
    require_quantity(volume.quantity, ("hu",), "hu_to_mu")
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
    lowest, highest = float(volume.array.min()), float(volume.array.max())
    if 0 < max(-lowest, highest) < _WATER_HU:
        warnings.warn(
            f"values of {lowest:.4g} to {highest:.4g} HU are those of water alone: are they CT numbers, or mu already?",
            InputWarning,
            stacklevel=2,
        )
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
        Not finite real numbers, or none at all; a volume of another quantity.
    """
    factor = np.float32(real_array(bone_attenuation_multiplier, "bone_attenuation_multiplier", ()))
    if isinstance(hu, Volume):
        require_quantity(hu.quantity, ("hu",), "diffdrr_density")
    hu = hu.array if isinstance(hu, Volume) else real_array(hu, "CT numbers", None, np.float32)
    if not hu.size:
        raise InputError("CT numbers: expected at least one")
    tissue = hu[(hu > DIFFDRR_AIR) & (hu <= DIFFDRR_BONE)]
    density = np.where(hu > DIFFDRR_BONE, hu * factor, hu)
    if tissue.size:
        density = np.where(hu <= DIFFDRR_AIR, tissue.min(), density)
    density -= density.min()
    return density / max(density.max(), np.finfo(np.float32).tiny)
