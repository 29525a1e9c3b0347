"""``mphdrr volume to-mesh FILE -o MESH``."""

from __future__ import annotations

import argparse

from ...volumes.meshes.mesh import MESH_FORMATS, MILLIMETRES, write_mesh
from ...volumes.meshes.surface import volume_to_mesh
from ..options import add_command, output_path, progress_bar
from .arguments import add_input, read_input


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_command(
        actions,
        "to-mesh",
        "make a closed mesh of the surface at a level, to show or to print",
        "mphdrr volume to-mesh ct.nii.gz --level 300 -o bones.stl",
    )
    add_input(parser)
    parser.add_argument(
        "--level", type=float, metavar="X", help="in the volume's unit; default: half way to the largest value"
    )
    parser.add_argument("--unit", choices=tuple(MILLIMETRES), help="of the mesh's lengths; default: mm, of .glb m")
    parser.add_argument("-o", "--output", required=True, metavar="MESH", help=", ".join(MESH_FORMATS))
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    path = output_path(arguments.output, MESH_FORMATS)
    mesh = volume_to_mesh(read_input(arguments), arguments.level, progress_bar("surface"))
    write_mesh(mesh, path, arguments.unit)
    print(f"{path}: {len(mesh.faces)} triangles around {mesh.volume * 1e-3:.4g} mL")
