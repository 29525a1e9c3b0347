"""Subject of radiographs: a CT, prepared as DiffDRR's ``read`` does it."""

from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...errors import InputError, warn
from ...geometry.frames import moved
from ...geometry.grid import Grid
from ...geometry.rotations import pose_matrix
from ...phantoms.torso import CardiacTorso
from ...physics.ct_numbers import diffdrr_density, mu_to_hu
from ...validation import freeze, real_array
from ...volumes.resampling import resample
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
    selection: Tensor | None = None
    """Mask (n_x, n_y, n_z) of the voxels of the chosen structures, outside which the density is 0; None for all."""

    def __iter__(self) -> Iterator[Any]:
        """Give CT numbers and voxel size, as before DiffDRR 0.4: ``volume, spacing = load_example_ct()``."""
        return iter((np.asarray(self.hu), np.linalg.norm(self.affine[:3, :3], axis=0).tolist()))

    @property
    def volume(self) -> SimpleNamespace:
        """The CT as DiffDRR's programs read it: `data` (1, n_x, n_y, n_z), `affine` and `spatial_shape`."""
        data = self.density if self.hu is None else self.hu
        return SimpleNamespace(data=data[None], affine=self.affine, spatial_shape=tuple(data.shape))


def read(
    volume: Any,
    labelmap: Any = None,
    labels: int | list[int] | None = None,
    orientation: str | None = "AP",
    bone_attenuation_multiplier: float = 1.0,
    center_volume: bool = True,
    *,
    affine: Any = None,
    **options: Any,
) -> Subject:
    """Read and prepare a CT as DiffDRR's ``read`` does.

    Parameters
    ----------
    volume
        CT numbers, HU: a file, a `Volume`, a ScalarImage of torchio, or an array or tensor with `affine`.
    labelmap, labels
        Structure numbers, and the numbers of the structures to keep; default: all. A file, a `Volume` or a LabelMap of
        torchio may be on any grid that covers the volume: each voxel gets the number at its centre. An array or tensor is
        on the voxels of the volume.
    orientation
        Direction of the camera: ``"AP"``, ``"PA"`` or None.
    bone_attenuation_multiplier
        Factor of the density for CT numbers above 350 HU.
    center_volume
        Whether to move the volume's centre to the world's origin.
    affine
        Matrix (4, 4), world mm from index, of an array or tensor.
    """
    for name in [name for name, value in options.items() if value is not None]:
        raise InputError(f"read has no argument {name!r}")
    is_file = isinstance(volume, str | PathLike)
    ct = _as_volume(read_volume_of(volume, "hu") if is_file else volume, "volume", affine)
    require_quantity(ct.quantity, ("hu",), "read")
    hu = torch.from_numpy(np.array(ct.array))
    density = hu_to_density(hu, bone_attenuation_multiplier)
    mask = selection = None
    if labelmap is not None:
        mask = _labels_on(ct.grid, labelmap)
    if labels is not None:
        if mask is None:
            raise InputError("labels: expected a labelmap as well, got none")
        selection = torch.from_numpy(np.isin(mask, real_array(labels, "labels", None)))
        density, mask = density * selection, mask * selection
    matrix = np.array(ct.grid.affine)
    if center_volume:
        matrix[:3, 3] -= ct.grid.center
    return Subject(density, matrix, reorientation(orientation), hu, mask, selection)


def _as_volume(image: Any, name: str, affine: Any) -> Volume:
    """Return a `Volume`, an image of torchio, or an array or tensor with `affine` as a `Volume`."""
    has_affine = isinstance(image, Volume) or (hasattr(image, "affine") and hasattr(image, "data"))
    if has_affine == (affine is not None):
        expected = "no affine, it has its own" if has_affine else "a file, a Volume, torchio's image, or also an affine"
        raise InputError(f"{name}: expected {expected}, got {type(image).__name__}")
    if isinstance(image, Volume):
        return image
    data, matrix = (image.data, image.affine) if has_affine else (image, affine)
    array = data.numpy(force=True) if isinstance(data, Tensor) else data
    array = array[0] if np.ndim(array) == 4 and len(array) == 1 else array  # torchio's channel
    values = real_array(array, name, (None, None, None), np.float32)
    return Volume(freeze(values), Grid(values.shape, matrix), "hu")  # type: ignore[arg-type]


def _labels_on(grid: Grid, labelmap: Any) -> Tensor:
    """Return the numbers of a label map at the centres of the voxels of `grid`, whole numbers (n_x, n_y, n_z)."""
    if isinstance(labelmap, str | PathLike):
        labelmap = read_volume(labelmap)
    affine = None if hasattr(labelmap, "affine") or isinstance(labelmap, Volume) else grid.affine
    labels = _as_volume(labelmap, "labelmap", affine)
    n = np.array(labels.grid.shape)
    if affine is not None and labels.grid.shape != grid.shape:
        raise InputError(f"labelmap: expected {grid.shape} voxels, as the volume has, got {labels.grid.shape}")
    if ((labels.array < 0) | (labels.array >= 2**24) | (labels.array % 1 != 0)).any():
        raise InputError("labelmap: expected whole numbers from 0 to 2^24 - 1, the numbers of structures")
    # The labels cover all voxels' centres if they cover the eight outermost ones.
    outermost = np.stack(np.meshgrid(*([0, size - 1] for size in grid.shape), indexing="ij"), -1).reshape(8, 3)
    index = moved(labels.grid.index_from_world @ grid.affine, outermost)
    if (np.abs(index - (n - 1) / 2) > n / 2 + 1e-3).any():
        raise InputError("labelmap: expected one that covers all of the volume, got one that ends in it: pad it with 0")
    padded = Volume(freeze(np.pad(labels.array, 1, "edge")), labels.grid.box((-1, -1, -1), tuple(n + 2)))
    return torch.from_numpy(resample(padded, grid, "nearest").array.astype(np.int32))


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
        density, hu = (image.data.reshape(image.data.shape[-3:]) for image in (data.density, data.volume))
        mask = getattr(data, "mask", None)
        mask = None if mask is None else _labels_on(Grid(density.shape, data.volume.affine), mask)
        return Subject(density, data.volume.affine, data.reorient, hu, mask)
    if affine is None:
        raise InputError(f"DRR: expected a subject, a Volume, or an array with `affine`, got {type(data).__name__}")
    array = data if isinstance(data, Tensor) else torch.from_numpy(real_array(data, "DRR: volume", None, np.float32))
    return Subject(array, np.asarray(affine, dtype=np.float64), reorientation("AP"))
