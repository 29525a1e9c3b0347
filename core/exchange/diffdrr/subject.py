"""Subject of radiographs: a CT, prepared as DiffDRR's ``read`` does it."""

from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...errors import InputError, warn
from ...geometry.grid import Grid
from ...geometry.rotations import pose_matrix
from ...phantoms.torso import CardiacTorso
from ...physics.ct_numbers import diffdrr_density, mu_to_hu
from ...validation import real_array, real_numbers
from ...volumes.volume import LINE_INTEGRALS, Volume, require_quantity
from ...volumes.volume_files import read_volume, read_volume_of

# Axes of the camera for each orientation of the C-arm, in the patient's frame (x left to right, y back to front, z up).
_ORIENTATIONS = {
    "AP": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    "PA": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    None: ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
}


@dataclass(frozen=True, eq=False)
class Subject:
    """Subject of radiographs: the density that is integrated, with its place in the world."""

    density: Tensor
    """Density (n_x, n_y, n_z) that is integrated along rays."""
    affine: np.ndarray[Any, Any]
    """Matrix (4, 4), world mm from index; an integer index is a voxel's centre."""
    reorient: Tensor
    """Matrix (4, 4) that turns the camera before the pose is applied."""
    hu: Tensor | None = None
    """CT numbers (n_x, n_y, n_z), HU, from which the density can be computed again; None where unknown."""
    mask: Tensor | None = None
    """Number (n_x, n_y, n_z) of the structure to which each voxel belongs; None without structures."""

    def __iter__(self) -> Iterator[Any]:
        """Give CT numbers and voxel size, as before DiffDRR 0.4: ``volume, spacing = load_example_ct()``."""
        return iter((np.asarray(self.hu), np.linalg.norm(self.affine[:3, :3], axis=0).tolist()))


def read(
    volume: str | PathLike[str] | Volume,
    labelmap: Any = None,
    labels: int | list[int] | None = None,
    orientation: str | None = "AP",
    bone_attenuation_multiplier: float = 1.0,
    center_volume: bool = True,
) -> Subject:
    """Read and prepare a CT as DiffDRR's ``read`` does.

    Parameters
    ----------
    volume
        File or `Volume` of CT numbers, HU.
    labelmap, labels
        File or array of structure numbers on the same voxels, and the numbers of the structures to keep; default: all.
    orientation
        Direction of the camera: ``"AP"``, ``"PA"`` or None.
    bone_attenuation_multiplier
        Factor of the density for CT numbers above 350 HU.
    center_volume
        Whether to move the volume's centre to the world's origin.
    """
    if isinstance(volume, Volume):
        require_quantity(volume.quantity, ("hu",), "read")
    else:
        volume = read_volume_of(volume, "hu")
    affine = np.array(volume.grid.affine)
    if center_volume:
        affine[:3, 3] -= volume.grid.center
    hu = torch.from_numpy(np.array(volume.array))
    density = hu_to_density(hu, bone_attenuation_multiplier)
    mask = None
    if labelmap is not None:
        array = read_volume(Path(labelmap)).array if isinstance(labelmap, str | PathLike) else labelmap
        mask = torch.from_numpy(np.array(real_numbers(array, "labelmap")))
        if mask.shape != hu.shape:
            raise InputError(f"labelmap: expected {tuple(hu.shape)} voxels, as the volume has, got {tuple(mask.shape)}")
    if labels is not None:
        if mask is None:
            raise InputError("labels: expected a labelmap as well, got none")
        density = density * torch.isin(mask, torch.as_tensor(labels).to(mask))
    return Subject(density, affine, reorientation(orientation), hu, mask)


def load_example_ct(**options: Any) -> Subject:
    """Return a phantom in place of DiffDRR's example CT, prepared with the `options` of `read`.

    mphDRR contains no CT of a patient. The phantom is `CardiacTorso` as CT numbers, -1001 to 320 HU, in 256 x 256 x 176
    voxels of 1.40625 x 1.40625 x 2.5 mm; DiffDRR's CT has 512 x 512 x 133 voxels, half as wide. An `InputWarning` tells that
    the CT is a phantom.
    """
    warn("load_example_ct: a phantom of mphDRR (CardiacTorso as CT numbers), not DiffDRR's CT of a patient", 2)
    grid = Grid.centered((256, 256, 176), (1.40625, 1.40625, 2.5), (35.0, -30.0, -30.0))  # around the whole body
    return read(mu_to_hu(CardiacTorso().voxelize(grid, quantity="mu"), CardiacTorso.mu_energy), **options)


def hu_to_density(hu: Tensor, bone_attenuation_multiplier: float = 1.0) -> Tensor:
    """Return DiffDRR's density of CT numbers, HU, from 0 to 1, with gradients; see `diffdrr_density`."""
    return diffdrr_density(hu.to(torch.float32), bone_attenuation_multiplier)


def reorientation(orientation: str | None) -> Tensor:
    """Return the camera's rotation (4, 4) for the orientation ``"AP"``, ``"PA"`` or None."""
    if orientation not in _ORIENTATIONS:
        raise InputError(f"orientation {orientation!r}: expected 'AP', 'PA' or None")
    return pose_matrix(torch.tensor(_ORIENTATIONS[orientation]), torch.zeros(3))


def as_subject(data: Any, affine: Any) -> Subject:
    """Return a `Subject` from a subject of torchio, a `Volume`, or an array or tensor with `affine`."""
    if isinstance(data, Subject):
        return data
    if isinstance(data, Volume):
        if data.quantity == "hu":
            raise InputError("DRR: expected a density, got CT numbers: give the volume to read, and its result to DRR")
        require_quantity(data.quantity, LINE_INTEGRALS, "DRR")
        return Subject(torch.from_numpy(np.array(data.array)), data.grid.affine, reorientation("AP"))
    if hasattr(data, "density"):  # a subject of torchio, from DiffDRR's own read
        mask = data.mask.data.squeeze() if getattr(data, "mask", None) is not None else None
        hu = data.volume.data.squeeze()
        return Subject(data.density.data.squeeze(), data.volume.affine, data.reorient, hu, mask)
    if affine is None:
        raise InputError(f"DRR: expected a subject, a Volume, or an array with `affine`, got {type(data).__name__}")
    array = data if isinstance(data, Tensor) else torch.from_numpy(real_array(data, "DRR: volume", None, np.float32))
    return Subject(array, np.asarray(affine, dtype=np.float64), reorientation("AP"))
