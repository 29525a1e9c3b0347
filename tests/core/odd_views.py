"""Views of deliberately odd geometry, for laws that must hold of any views."""

import numpy as np

import mphdrr.core as mph
from mphdrr.core.geometry.frames import affine_matrix, module_frames


def odd_views(parallel: bool = False) -> mph.Views:
    """Return six views of the isocentre's surroundings, each odd in another way; all have the isocentre in their image.

    Pixels of other pitch along u and v, the principal point off the centre, a turn about the axis, a mirrored grid, skewed
    pixels, an oblique detector; and one view with all of it.
    """
    centers = np.array(
        [[220.0, 30, 10], [-40, 200, -25], [150, -140, 60], [-190, -20, -70], [60, 90, 180], [-120, 130, 55]]
    )
    frames = module_frames(centers)
    distances = np.array([400.0, 350, 500, 420, 610, 380])
    pitches = np.array([[2.0, 3.1], [2.5, 2.5], [2.9, 2.2], [3.0, 3.0], [3.5, 3.2], [3.3, 2.4]])
    offsets = np.array([[0.0, 0], [31, -17], [0, 0], [0, 0], [9, 5], [-21, 12]])  # mm, of the detector's centre
    u_steps, v_steps = pitches[:, :1] * frames[:, 0], pitches[:, 1:] * frames[:, 1]
    for m, angle in ((2, 0.7), (5, -2.1)):  # turned about the axis
        u, v = u_steps[m].copy(), v_steps[m].copy()
        u_steps[m] = np.cos(angle) * u + np.sin(angle) * pitches[m, 0] * frames[m, 1]
        v_steps[m] = np.cos(angle) * v - np.sin(angle) * pitches[m, 1] * frames[m, 0]
    v_steps[[3, 5]] *= -1  # mirrored
    for m, share in ((4, 0.3), (5, -0.2)):  # skewed
        v_steps[m] += share * u_steps[m]
    for m in (4, 5):  # oblique
        tilt = affine_matrix(frames[m].T, [0, 0, 0]) @ mph.euler_pose(0.4, 0.35, -0.2)
        turn = tilt[:3, :3] @ frames[m]
        u_steps[m], v_steps[m] = turn @ u_steps[m], turn @ v_steps[m]
    middles = centers + distances[:, None] * frames[:, 2] + np.einsum("mi,mij->mj", offsets, frames[:, :2])
    return mph.Views(centers, middles, u_steps, v_steps, (90, 100), parallel)


def moved_views(views: mph.Views, pose: np.ndarray) -> mph.Views:
    """Return views that a pose (4, 4) has moved in space."""
    points = (x @ pose[:3, :3].T + pose[:3, 3] for x in (views.sources, views.detector_centers))
    steps = (x @ pose[:3, :3].T for x in (views.u_steps, views.v_steps))
    return mph.Views(*points, *steps, views.shape, views.parallel)
