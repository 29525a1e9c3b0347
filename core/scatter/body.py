"""Bodies in which photons scatter: densities of water and bone in voxels, and the tables of the two materials."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from ..arrays import Floats, Floats32
from ..errors import InputError
from ..geometry.grid import Grid
from ..physics.ct_numbers import hu_to_mu
from ..physics.mass_attenuation import HIGHEST_ENERGY
from ..physics.materials import attenuation
from ..physics.photon_scattering import WAVELENGTH_ENERGY, Scatterer
from ..validation import freeze
from ..volumes.volume import Volume, require_quantity

SCATTERERS = (Scatterer("water"), Scatterer("bone"))
LOWEST_ENERGY = 30.0
"""Energy, keV, below which photons of activity are not followed."""
LOWEST_XRAY_ENERGY = 10.0
"""Energy, keV, below which photons of tubes are not followed."""
_MOMENTA = 2048
_ENERGIES = np.geomspace(LOWEST_XRAY_ENERGY, HIGHEST_ENERGY, 84)


@dataclass(frozen=True, eq=False)
class Body:
    """Densities of water and bone in the voxels of a grid."""

    grid: Grid
    densities: Floats32
    """Densities (n_x, n_y, n_z, 2) of `SCATTERERS`, each as a share of the material's own."""

    @classmethod
    def of(cls, volume: Volume, energy: float) -> "Body":
        """Return the body of a volume of CT numbers ("hu"), or of attenuation coefficients at `energy`, keV ("mu").

        CT numbers become mu as by `hu_to_mu`, and mu becomes what that function mixes: up to water's it is water of less
        density, above it a mixture of water and cortical bone. Voxels around the body that hold nothing are left out.
        """
        require_quantity(volume.quantity, ("hu", "mu"), "scatter: body")
        water, bone = (attenuation(scatterer.material, energy) for scatterer in SCATTERERS)
        mu = (volume if volume.quantity == "mu" else hu_to_mu(volume, energy)).array.astype(np.float64)
        if mu.size and mu.min() < 0:
            raise InputError(f"scatter: body: expected attenuation coefficients of 0 or more, got {mu.min():g}")
        share = np.clip((mu - water) / (bone - water), 0, 1)  # of bone
        of_bone = np.where(share < 1, share, mu / bone)
        densities = np.stack([np.maximum(mu - of_bone * bone, 0) / water, of_bone], axis=-1)
        filled = np.nonzero(mu > 2e-3 * water)  # air is not
        if not len(filled[0]):
            return cls(volume.grid.box((0, 0, 0), (1, 1, 1)), freeze(np.zeros((1, 1, 1, 2), np.float32)))
        first, end = (np.array([f(i) for i in filled]) for f in (np.min, np.max))
        box = tuple(slice(a, b + 1) for a, b in zip(first, end, strict=True))
        grid = volume.grid.box(first, tuple(int(n) for n in end + 1 - first))
        return cls(grid, freeze(np.ascontiguousarray(densities[box], np.float32)))


def coefficients(energies: Floats) -> Floats32:
    """Return the attenuation coefficients (3, 2, n), 1/mm, total, incoherent and coherent, of `SCATTERERS` at `energies`."""
    logs = [np.log(_coefficients_of(scatterer)) for scatterer in SCATTERERS]
    tables = [[np.interp(np.log(energies), np.log(_ENERGIES), row) for row in table] for table in logs]
    return np.ascontiguousarray(np.exp(tables).swapaxes(0, 1), np.float32)


@cache
def _coefficients_of(scatterer: Scatterer) -> Floats:
    """Return the coefficients (3, n) of a scatterer at `_ENERGIES`."""
    return np.array([scatterer.coefficients(float(energy)) for energy in _ENERGIES]).T


@dataclass(frozen=True, eq=False)
class MomentumTables:
    """Functions of the momentum transfer x at even steps of sqrt(x), each (2, n), of `SCATTERERS`."""

    per_root: float
    """Steps in a unit of sqrt(x)."""
    incoherent: Floats32
    """`Scatterer.incoherent_function`, 1/mm."""
    coherent: Floats32
    """`Scatterer.coherent_function`, 1/mm."""
    coherent_until: Floats32
    """Integral of `coherent` over x^2 from 0."""


@cache
def momentum_tables() -> MomentumTables:
    """Return the functions up to the largest momentum transfer of all energies."""
    roots = np.linspace(0, np.sqrt(HIGHEST_ENERGY / WAVELENGTH_ENERGY), _MOMENTA)
    incoherent, coherent = (
        np.array([f(scatterer, roots**2) for scatterer in SCATTERERS])
        for f in (Scatterer.incoherent_function, Scatterer.coherent_function)
    )
    steps = (coherent[:, 1:] + coherent[:, :-1]) / 2 * np.diff(roots**4)
    until = np.concatenate([np.zeros((len(SCATTERERS), 1)), np.cumsum(steps, axis=1)], axis=1)
    tables = (np.ascontiguousarray(table, np.float32) for table in (incoherent, coherent, until))
    return MomentumTables((_MOMENTA - 1) / roots[-1], *tables)
