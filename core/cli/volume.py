"""Command ``mphdrr volume ACTION``: facts about volumes, conversion, and meshes from and to volumes."""

import argparse
from typing import Any

import numpy as np

from ... import core as mph
from ..geometry.grid import grid_around
from ..physics.isotopes import photon_energy
from ..validation import positive, real_array, shape_text
from ..volumes.formats.dicom_writing import parse_tags
from ..volumes.meshes.mesh import MESH_FORMATS, MILLIMETRES
from ..volumes.volume import UNITS
from ..volumes.volume_files import VOLUME_FORMATS
from .options import add_actions, add_run, describe_volume, expand_to_three, output_path, print_answer, progress_bar

_MESH_UNIT: dict[str, Any] = {
    "choices": tuple(MILLIMETRES),
    "help": "unit of length in the mesh files; default: mm, in .glb m",
}


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command ``mphdrr volume`` with its actions."""
    actions = add_actions(subparsers, "volume", "mphdrr volume info ct.nii.gz")

    info = add_run(actions, "info", _info)
    _add_input(info)
    info.add_argument("--json", action="store_true", help="print JSON")

    convert = add_run(actions, "convert", _convert)
    _add_input(convert)
    add = convert.add_argument_group("changes, in this order").add_argument
    add("--canonical", action="store_true", help="flip and transpose: index axes to the right, front and head")
    box = ("X0", "X1", "Y0", "Y1", "Z0", "Z1")
    add("--crop", type=float, nargs=6, metavar=box, help="crop to a box, mm, in FILE's world")
    add("--pad", type=int, default=0, metavar="N", help="add N voxels on every side")
    add("--center", action="store_true", help="move the centre to the isocentre")
    add("--spacing", type=float, nargs="+", metavar="MM", help="resample to this voxel size, one or three")
    method = "interpolation; default: mean for larger voxels, else linear; labels need nearest"
    add("--method", choices=("linear", "nearest", "mean"), help=method)
    add("--from-mu", metavar="KEV", help="attenuation at KEV, or an isotope's line, to CT numbers")
    add("--to-mu", action="store_true", help="CT numbers to attenuation, 1/mm, at --energy")
    energy = "photon energy, or an isotope's name for its strongest line (default: 140.5)"
    convert.add_argument("--energy", metavar="KEV", help=energy)
    convert.add_argument("-o", "--output", required=True, metavar="FILE", help=", ".join(VOLUME_FORMATS))
    template = "DICOM file of which .dcm takes the tags of patient, study and series"
    convert.add_argument("--template", metavar="FILE", help=template)
    tag = "tag of patient, study or series for .dcm, as PatientName=Doe^Jo; may be repeated"
    convert.add_argument("--tag", action="append", default=[], metavar="KEYWORD=VALUE", help=tag)

    add = add_run(actions, "from-mesh", _from_mesh).add_argument
    add("mesh", nargs="+", metavar="MESH", help=f"{', '.join(MESH_FORMATS)}; later ones replace earlier ones")
    add("--unit", **_MESH_UNIT)
    add("--value", type=float, nargs="+", default=[1.0], metavar="X", help="value inside, one for all or one per mesh")
    add("--quantity", choices=tuple(UNITS), default="activity", help="quantity of the values")
    add("--spacing", type=float, default=1.0, metavar="MM", help="voxel size")
    voxels = "numbers of voxels along x y z, around the isocentre; default: around the meshes"
    add("--voxels", type=int, nargs=3, metavar="N", help=voxels)
    add("-o", "--output", required=True, metavar="FILE", help=", ".join(VOLUME_FORMATS))

    to_mesh = add_run(actions, "to-mesh", _to_mesh)
    _add_input(to_mesh)
    level = "value at the surface, in the volume's unit; default: halfway to the largest value"
    to_mesh.add_argument("--level", type=float, metavar="X", help=level)
    to_mesh.add_argument("--unit", **_MESH_UNIT)
    to_mesh.add_argument("-o", "--output", required=True, metavar="MESH", help=", ".join(MESH_FORMATS))


def _add_input(parser: argparse.ArgumentParser) -> None:
    """Add the options that name the volume to read, for `_read_input`."""
    add = parser.add_argument
    add("file", metavar="FILE", help="volume, folder of a DICOM series, or any file of one (formats: docs/volumes.md)")
    add("--quantity", choices=tuple(UNITS), help="quantity of its values; default: the file's, else CT numbers, hu")
    add("--series", metavar="NAME", help="one of several DICOM series, by number, description or UID")
    affine = "4 x 4 matrix from index to world mm, row by row, in place of the file's; .npy needs it"
    add("--affine", type=float, nargs=16, metavar="A", help=affine)


def _read_input(arguments: argparse.Namespace) -> mph.Volume:
    """Read the volume that the options of `_add_input` name."""
    affine = None if arguments.affine is None else np.reshape(arguments.affine, (4, 4))
    options: dict[str, Any] = {"affine": affine, "series": arguments.series, "progress": progress_bar("reading")}
    return mph.read_volume(arguments.file, arguments.quantity, **options)


def _info(arguments: argparse.Namespace) -> None:
    """Show a volume's position, grid and values.

    mphdrr volume info ct.nii.gz
    """
    from nibabel.orientations import aff2axcodes

    volume = _read_input(arguments)
    array, grid = volume.array, volume.grid
    corners = grid.corners()
    facts = {
        "quantity": volume.quantity,
        "unit": volume.unit,
        "voxels": list(grid.shape),
        "spacing_mm": grid.spacing.tolist(),
        "axes": "".join(aff2axcodes(grid.affine)),  # the closest of R, L, A, P, S and I
        "center_mm": grid.center.tolist(),
        "low_mm": corners.min(axis=0).tolist(),
        "high_mm": corners.max(axis=0).tolist(),
        "smallest": float(array.min()),
        "mean": float(array.mean(dtype=np.float64)),
        "largest": float(array.max()),
    }
    lines = []
    for name, value in facts.items():
        text = " ".join(f"{x:g}" if isinstance(x, float) else str(x) for x in np.atleast_1d(value).tolist())
        lines.append(f"{name:16s} {text}")
    print_answer(arguments, {**facts, "affine": grid.affine.tolist()}, lines)


def _convert(arguments: argparse.Namespace) -> None:
    """Convert a volume to another format; crop, move or resample it, or convert it to attenuation.

    mphdrr volume convert dicom_folder --center --spacing 2 --to-mu --energy Tc-99m -o mu.nii.gz
    mphdrr volume convert mu70.nii.gz --from-mu 70 --to-mu --energy Tc-99m -o mu.nii.gz
    mphdrr volume convert osem.nii.gz --template ct/0001.dcm --tag SeriesDescription=OSEM -o osem.dcm
    """
    path = output_path(arguments.output, VOLUME_FORMATS)
    if arguments.energy is not None and not arguments.to_mu:
        raise mph.InputError("--energy needs --to-mu")
    if arguments.method is not None and not arguments.spacing:
        raise mph.InputError("--method needs --spacing")
    energy = photon_energy(arguments.energy or "140.5")
    volume = _read_input(arguments)
    if arguments.canonical:
        volume = mph.canonical(volume)
    if arguments.crop:
        volume = mph.crop_to_box(volume, arguments.crop[::2], arguments.crop[1::2])
    if arguments.pad:
        volume = mph.pad(volume, arguments.pad, arguments.pad)
    if arguments.center:
        volume = mph.centered(volume)
    if arguments.spacing:
        volume = _resample_to_spacing(volume, arguments.spacing, arguments.method)
    if arguments.from_mu is not None:
        volume = mph.mu_to_hu(volume, photon_energy(arguments.from_mu))
    if arguments.to_mu:
        volume = mph.hu_to_mu(volume, energy)
    mph.write_volume(volume, path, template=arguments.template, tags=parse_tags(arguments.tag))
    print(f"{path}: {describe_volume(volume)} {volume.unit}")


def _resample_to_spacing(volume: mph.Volume, spacing: list[float], method: str | None) -> mph.Volume:
    """Return the volume on a grid of another voxel size, with the same axes and first faces, that covers the old one."""
    if len(spacing) not in (1, 3) or not min(spacing) > 0:
        got = " ".join(f"{x:g}" for x in spacing)
        raise mph.InputError(f"--spacing: expected one or three numbers above 0, got {got}")
    old = volume.grid
    steps = expand_to_three(spacing) / old.spacing  # in old voxels
    shape = np.maximum(1, np.ceil(old.shape / steps - 1e-6)).astype(int)
    index = np.diag([*steps, 1.0])
    index[:3, 3] = (steps - 1) / 2
    method = method or ("mean" if steps.max() > 1 else "linear")
    # A label file states no quantity and is taken for CT numbers, but outside it the value is 0 and not that of air.
    outside = 0.0 if method == "nearest" and volume.array.min() >= 0 else None
    return mph.resample(volume, mph.Grid(shape, old.affine @ index), method, outside, progress_bar("resampling"))


def _from_mesh(arguments: argparse.Namespace) -> None:
    """Fill closed meshes with activity or attenuation.

    mphdrr volume from-mesh body.stl heart.stl --value 0.0154 0.0160 --quantity mu --spacing 2 -o mu.nii.gz
    """
    path = output_path(arguments.output, VOLUME_FORMATS)
    if len(arguments.value) not in (1, len(arguments.mesh)):
        raise mph.InputError(f"--value: expected one number, or one for each of {len(arguments.mesh)} meshes")
    values = real_array(np.broadcast_to(arguments.value, len(arguments.mesh)), "--value", (None,))
    meshes = [mph.read_mesh(file, arguments.unit) for file in arguments.mesh]
    spacing = positive(arguments.spacing, "--spacing", "mm")
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    grid = mph.Grid.centered(arguments.voxels, spacing) if arguments.voxels else grid_around(vertices, spacing)
    volume = mph.voxelize_mesh(meshes, grid, values, arguments.quantity, progress_bar("voxelizing"))
    mph.write_volume(volume, path)
    covered = np.count_nonzero(volume.array) * grid.voxel_volume * 1e-3
    print(f"{path}: {shape_text(grid.shape)} voxels, {covered:.4g} mL of them not 0")


def _to_mesh(arguments: argparse.Namespace) -> None:
    """Make a closed mesh of the surface at a value of the volume, to show or to print.

    mphdrr volume to-mesh ct.nii.gz --level 300 -o bones.stl
    """
    path = output_path(arguments.output, MESH_FORMATS)
    mesh = mph.volume_to_mesh(_read_input(arguments), arguments.level, progress_bar("surface"))
    mph.write_mesh(mesh, path, arguments.unit)
    print(f"{path}: {len(mesh.faces)} triangles around {mesh.volume * 1e-3:.4g} mL")
