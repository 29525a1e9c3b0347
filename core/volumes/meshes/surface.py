"""Surface of a volume at a level as a closed mesh, for display and 3-D printing.

Marching tetrahedra (A. Doi, A. Koide, IEICE Trans. E74 (1991) 214-224): each cube between eight voxels' centres is divided
into H. Kuhn's six tetrahedra, in the same way in all cubes. The surface is therefore closed for all values, which the tables
of marching cubes do not guarantee. A compiled library would be faster, but one more wheel for every platform.
"""

from collections.abc import Iterator
from itertools import permutations

import numpy as np

from ...arrays import Floats, Floats32, Integers
from ...errors import InputError
from ...geometry.frames import moved
from ...memory import require
from ...progress import Progress, tell
from ...validation import instance, real_array
from ..volume import Volume, outside_value
from .mesh import Mesh

# A cube's corners are numbered 4 x + 2 y + z. A tetrahedron's corners are those of a path from corner 0 to corner 7 along
# the three axes, in one of their six orders.
_PATHS = list(permutations((4, 2, 1)))
_TETRAHEDRA = [np.cumsum((0, *path)) for path in _PATHS]
_IS_MIRRORED = [path in ((4, 1, 2), (2, 4, 1), (1, 2, 4)) for path in _PATHS]  # odd permutations
_CORNERS = np.array([[n >> 2 & 1, n >> 1 & 1, n & 1] for n in range(8)])


def volume_to_mesh(volume: Volume, level: float | None = None, progress: Progress | None = None) -> Mesh:
    """Return the closed surface around the voxels with values of at least `level`.

    On the surface, the volume interpolated between the voxels' centres has the value `level`. Outside the grid the value is
    0 (CT numbers: -1000), so that the surface is closed at the grid's border. The default level is halfway between the value
    outside and the largest value. `progress` is called as ``progress(done, total)``; it may raise `Cancelled`.
    """
    instance(volume, Volume, "volume_to_mesh")
    outside = outside_value(volume)
    highest = float(volume.array.max())
    level = (outside + highest) / 2 if level is None else float(real_array(level, "level", ()))
    if not outside < level <= highest:
        limits = f"above {outside:g}, the value outside the grid, and at most {highest:g}, the largest"
        raise InputError(f"level {level:g}: expected {limits}")
    array = volume.array
    shape = np.array(array.shape) + 2  # with a margin of one voxel
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    planes = [_padded_plane(array, i, outside) for i in (-1, 0)]
    keys, fractions = [], []
    for i in range(shape[0] - 1):
        for new_keys, new_fractions in _triangles(planes[0], planes[1], level, i * strides[0], strides):
            keys.append(new_keys)
            fractions.append(new_fractions)
        planes = [planes[1], _padded_plane(array, i + 1, outside)]
        tell(progress, i + 1, int(shape[0]) - 1)
    key = np.concatenate(keys)
    require(200.0 * key.size, f"a mesh of {len(key)} triangles")
    edges, first, faces = np.unique(key, return_index=True, return_inverse=True)
    corner, direction = np.divmod(edges, 8)
    index = np.stack(np.unravel_index(corner, shape), axis=1) - 1.0
    index += np.concatenate(fractions).reshape(-1)[first, None] * _CORNERS[direction]
    is_mirrored = np.linalg.det(volume.grid.affine[:3, :3]) < 0
    return Mesh(moved(volume.grid.affine, index), faces.reshape(-1, 3)[:, :: -1 if is_mirrored else 1])


def _padded_plane(array: Floats32, i: int, outside: float) -> Floats:
    """Return the values of plane `i` along the first axis with a margin of one voxel of the value `outside`."""
    if 0 <= i < len(array):
        return np.pad(array[i].astype(np.float64), 1, constant_values=outside)
    return np.full((array.shape[1] + 2, array.shape[2] + 2), outside)


def _triangles(
    below: Floats, above: Floats, level: float, first: int, strides: Integers
) -> Iterator[tuple[Integers, Floats]]:
    """Yield triangles between two planes of values, in groups: keys (N, 3) of their corners' edges, and fractions (N, 3).

    The key of an edge is 8 times the flat index of its lower end, plus the number of the cube's corner in its direction; the
    fraction, 0 to 1, is the position on the edge. `first` is the flat index of the lower plane's first voxel.
    """
    corners = [(plane, y, z) for plane in (below, above) for y, z in np.ndindex(2, 2)]
    values = np.stack([plane[y : y - 1 or None, z : z - 1 or None] for plane, y, z in corners])
    inside = values >= level
    j, k = np.nonzero(inside.any(axis=0) & ~inside.all(axis=0))
    values, inside = values[:, j, k], inside[:, j, k]
    corner = first + j * strides[1] + k * strides[2] + (_CORNERS @ strides)[:, None]
    for tetrahedron, is_mirrored in zip(_TETRAHEDRA, _IS_MIRRORED, strict=True):
        case = (1 << np.arange(4)) @ inside[tetrahedron]
        for number, triangles in _CASES.items():
            cubes = np.flatnonzero(case == number)
            for triangle in triangles if len(cubes) else ():
                ends = tetrahedron[np.array(triangle[::-1] if is_mirrored else triangle)]  # (3, 2)
                low, high = ends.min(axis=1), ends.max(axis=1)
                start, stop = values[low][:, cubes], values[high][:, cubes]
                keys = corner[low][:, cubes] * 8 + (high - low)[:, None]
                yield keys.T, ((level - start) / (stop - start)).T


def _make_cases() -> dict[int, list[list[tuple[int, int]]]]:
    """Return the triangles for each set of a tetrahedron's corners that are inside, by the set's bits.

    A triangle's corners are edges (corner inside, corner outside), counter-clockwise as seen from outside.
    """
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]])  # corners of the first tetrahedron
    cases = {}
    for number in range(1, 15):
        inside = [n for n in range(4) if number >> n & 1]
        outside = [n for n in range(4) if not number >> n & 1]
        edges = [(a, b) for a in inside for b in outside]
        if len(edges) == 4:  # in order around the quadrilateral
            edges[2:] = edges[:1:-1]
        a, b, c = (points[list(edge)].mean(axis=0) for edge in edges[:3])
        if np.cross(b - a, c - a) @ (points[outside].mean(axis=0) - points[inside].mean(axis=0)) < 0:
            edges.reverse()
        cases[number] = [[edges[0], edges[n], edges[n + 1]] for n in range(1, len(edges) - 1)]
    return cases


_CASES = _make_cases()
