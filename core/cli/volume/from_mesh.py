"""``mphdrr volume from-mesh MESH -o OUT``."""

from __future__ import annotations

import argparse

import numpy as np

from ...errors import InputError
from ...geometry.grid import Grid
from ...validation import positive, real_array
from ...volumes.meshes.mesh import MESH_FORMATS, MILLIMETRES, Mesh, read_mesh
from ...volumes.meshes.voxelization import voxelize_mesh
from ...volumes.volume import UNITS
from ...volumes.volume_files import VOLUME_FORMATS, write_volume
from ..options import add_command, output_path, progress_bar


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_command(
        actions,
        "from-mesh",
        "fill closed meshes with activity or attenuation",
        "mphdrr volume from-mesh body.stl heart.stl --value 0.0154 0.0160 --quantity mu --spacing 2 -o mu.nii.gz",
    )
    parser.add_argument(
        "mesh", nargs="+", metavar="MESH", help=f"{', '.join(MESH_FORMATS)}; later ones replace earlier ones"
    )
    parser.add_argument("--unit", choices=tuple(MILLIMETRES), help="of the files' lengths; default: mm, of .glb m")
    parser.add_argument(
        "--value", type=float, nargs="+", default=[1.0], metavar="X", help="inside: one, or one per mesh"
    )
    parser.add_argument("--quantity", choices=tuple(UNITS), default="activity", help="what the values are")
    parser.add_argument("--spacing", type=float, default=1.0, metavar="MM", help="voxel size")
    parser.add_argument(
        "--voxels", type=int, nargs=3, metavar="N", help="along x y z, around the isocentre; default: around the meshes"
    )
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=", ".join(VOLUME_FORMATS))
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    path = output_path(arguments.output, VOLUME_FORMATS)
    if len(arguments.value) not in (1, len(arguments.mesh)):
        raise InputError(f"--value: expected one number, or one for each of {len(arguments.mesh)} meshes")
    values = real_array(np.broadcast_to(arguments.value, len(arguments.mesh)), "--value", (None,))
    meshes = [read_mesh(file, arguments.unit) for file in arguments.mesh]
    grid = _grid(meshes, arguments)
    volume = voxelize_mesh(meshes, grid, values, arguments.quantity, progress_bar("voxelizing"))
    write_volume(volume, path)
    covered = np.count_nonzero(volume.array) * grid.voxel_volume * 1e-3
    print(f"{path}: {' x '.join(map(str, grid.shape))} voxels, {covered:.4g} mL of them not 0")


def _grid(meshes: list[Mesh], arguments: argparse.Namespace) -> Grid:
    """The grid asked for; by default around the meshes with a margin of one voxel."""
    spacing = positive(arguments.spacing, "--spacing", "mm")
    if arguments.voxels:
        return Grid.centered(arguments.voxels, spacing)
    low = np.min([mesh.vertices.min(axis=0) for mesh in meshes], axis=0)
    high = np.max([mesh.vertices.max(axis=0) for mesh in meshes], axis=0)
    return Grid.centered(np.ceil((high - low) / spacing) + 2, spacing, (low + high) / 2)
