"""What is imaged: a CT as DiffDRR's ``read`` prepares it."""

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

# The C-arm's frames of reference: the camera's axes in the patient's (x left to right, y back to front, z up).
_ORIENTATIONS = {
    "AP": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    "PA": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    None: ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
}


@dataclass(frozen=True, eq=False)
class Subject:
    """What is imaged."""

    density: Tensor  # (n_x, n_y, n_z), what is integrated
    affine: np.ndarray[Any, Any]  # (4, 4), world mm from index; an integer index is a voxel's centre
    reorient: Tensor  # (4, 4), turns the camera before its pose does
    hu: Tensor | None = None  # CT numbers, from which the density can be computed again
    mask: Tensor | None = None  # whole numbers (n_x, n_y, n_z): the structure to which each voxel belongs

    def __iter__(self) -> Iterator[Any]:
        """CT numbers and voxel size, as before DiffDRR 0.4: ``volume, spacing = load_example_ct()``."""
        return iter((np.asarray(self.hu), np.linalg.norm(self.affine[:3, :3], axis=0).tolist()))


def read(
    volume: str | PathLike[str] | Volume,
    labelmap: Any = None,
    labels: int | list[int] | None = None,
    orientation: str | None = "AP",
    bone_attenuation_multiplier: float = 1.0,
    center_volume: bool = True,
) -> Subject:
    """A CT as DiffDRR's ``read`` prepares it.

    Parameters
    ----------
    volume
        File or `Volume` of CT numbers, HU.
    labelmap, labels
        File or array of structures on the same voxels, and those of them to keep; all by default.
    orientation
        The camera's direction: ``"AP"``, ``"PA"`` or None.
    bone_attenuation_multiplier
        Factor for CT numbers above 350 HU.
    center_volume
        Move the volume's middle to the world's origin.
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
            raise InputError("labels: expected a labelmap too")
        density = density * torch.isin(mask, torch.as_tensor(labels).to(mask))
    return Subject(density, affine, reorientation(orientation), hu, mask)


def load_example_ct(**options: Any) -> Subject:
    """A phantom in place of DiffDRR's example, with the `options` of `read`: mphDRR has no patient's CT.

    It is `CardiacTorso` as CT numbers, -1001 to 320 HU, in 256 x 256 x 176 voxels of 1.40625 x 1.40625 x 2.5 mm. DiffDRR's
    are 512 x 512 x 133, half as wide. An `InputWarning` says so.
    """
    warn("load_example_ct: a phantom of mphDRR (CardiacTorso as CT numbers), not DiffDRR's CT of a patient", 2)
    grid = Grid.centered((256, 256, 176), (1.40625, 1.40625, 2.5), (35.0, -30.0, -30.0))  # around the whole body
    return read(mu_to_hu(CardiacTorso().voxelize(grid, quantity="mu"), CardiacTorso.mu_energy), **options)


def hu_to_density(hu: Tensor, bone_attenuation_multiplier: float = 1.0) -> Tensor:
    """`diffdrr_density` of a tensor, with gradients: 0 to 1, air as thin as the thinnest tissue, bone times a factor."""
    return diffdrr_density(hu.to(torch.float32), bone_attenuation_multiplier)


def reorientation(orientation: str | None) -> Tensor:
    """The matrix (4, 4) of ``"AP"``, ``"PA"`` or None."""
    if orientation not in _ORIENTATIONS:
        raise InputError(f"orientation {orientation!r}: expected 'AP', 'PA' or None")
    return pose_matrix(torch.tensor(_ORIENTATIONS[orientation]), torch.zeros(3))


def as_subject(given: Any, affine: Any) -> Subject:
    """A `Subject` from torchio's, a `Volume`, or an array or tensor with `affine`."""
    if isinstance(given, Subject):
        return given
    if isinstance(given, Volume):
        if given.quantity == "hu":
            raise InputError("DRR: CT numbers are not a density; give the volume to read, and its answer to DRR")
        require_quantity(given.quantity, LINE_INTEGRALS, "DRR")
        return Subject(torch.from_numpy(np.array(given.array)), given.grid.affine, reorientation("AP"))
    if hasattr(given, "density"):  # torchio's, from DiffDRR's read
        mask = given.mask.data.squeeze() if getattr(given, "mask", None) is not None else None
        hu = given.volume.data.squeeze()
        return Subject(given.density.data.squeeze(), given.volume.affine, given.reorient, hu, mask)
    if affine is None:
        raise InputError(f"DRR: expected a subject, a Volume, or an array with `affine`, got {type(given).__name__}")
    array = given if isinstance(given, Tensor) else torch.from_numpy(real_array(given, "DRR: volume", None, np.float32))
    return Subject(array, np.asarray(affine, dtype=np.float64), reorientation("AP"))
