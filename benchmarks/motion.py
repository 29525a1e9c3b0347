"""Bias and scatter of motions found from X rays, against closed forms: ``python -m benchmarks.motion``.

The body is ellipsoids. Their chords are computed at 6 x 6 points of each pixel, and pixels count the mean transmission
with Poisson noise. The reference is the same body in voxels, each the mean of 6^3 points.
"""

from dataclasses import replace

import numpy as np

import mphdrr.core as mph
from mphdrr.core.geometry.frames import rotations

BODY = (
    ((66, 42, 56), (0, 0, 0), 0.020),
    ((20, 14, 30), (-22, 8, 4), -0.014),
    ((16, 20, 12), (26, -10, -14), 0.015),
    ((10, 7, 14), (10, 20, 18), 0.008),
)
"""Semi-axes and centre, mm, and mu beside that of the ellipsoid around it, 1/mm."""
MOTIONS = ((0, 0, 0), (0, 0, 0)), ((1, -2, 1), (0.02, 0.01, -0.03))
VIEWS = mph.xray_arc(shape=(64, 64)).views()


def transmissions(views, shift, rotation, points=6):
    """Return the mean transmission of each pixel, (M, n_v, n_u), after a motion about the origin."""
    turn = rotations(np.array([rotation], float))[0]
    n_v, n_u = views.shape
    steps = {"u_steps": views.u_steps / points, "v_steps": views.v_steps / points}
    fine = replace(views, shape=(n_v * points, n_u * points), **steps)
    images = np.zeros((len(views), n_v, n_u))
    for m in range(len(views)):
        sources, targets = (np.subtract(x, shift) @ turn for x in fine.rays(m))
        directions = (targets - sources) / np.linalg.norm(targets - sources, axis=-1, keepdims=True)
        paths = 0
        for radii, center, mu in BODY:
            a, b = (sources - center) / radii, directions / radii
            aa, ab, bb = (a * a).sum(-1), (a * b).sum(-1), (b * b).sum(-1)
            paths = paths + 2 * mu * np.sqrt(np.maximum(ab**2 - bb * (aa - 1), 0)) / bb
        images[m] = np.exp(-paths).reshape(n_v, points, n_u, points).mean((1, 3))
    return images


def reference(n, spacing, points=6):
    """Return the body in n^3 voxels, mm^-1."""
    places = (np.arange(n * points) + 0.5) * spacing / points - n * spacing / 2
    values = np.zeros((n, n, n))
    for i, x in enumerate(places.reshape(n, points)):
        grid = np.stack(np.meshgrid(x, places, places, indexing="ij", sparse=False), -1)
        fine = sum(mu * ((((grid - center) / radii) ** 2).sum(-1) < 1) for radii, center, mu in BODY)
        values[i] = fine.reshape(points, n, points, n, points).mean((0, 2, 4))
    return mph.Volume(values, mph.Grid.centered(n, spacing), "mu")


def errors(volume, views, photons, motion, n_draws):
    """Return the error without noise (6,), those of draws (n, 6), mm and rad, and the stated variances (n, 6)."""
    images = transmissions(views, *motion)
    finder = mph.MotionFinder(volume, views, photons)
    exact = finder(-np.log(images))
    rng = np.random.default_rng(0)
    counts = [np.maximum(rng.poisson(photons * images), 0.5) for _ in range(n_draws)]
    found = [finder(np.log(photons / x), start=exact) for x in counts]
    numbers = np.array([[*m.shift, *m.rotation] for m in (exact, *found)]) - np.concatenate(motion)
    return numbers[0], numbers[1:], np.array([np.diag(m.covariance) for m in found])


def main():
    """Print a line for each number of photons, voxel and motion: largest bias of shift and turn, and SDs said and seen."""
    print(
        "| photons | voxels, mm | motion | bias, mm | bias, degrees | bias, SD | SD, mm | SD, degrees | said / seen |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for spacing, n in ((3.0, 48),):
        volume = reference(n, spacing)
        for photons in (200, 1000):
            for motion in MOTIONS:
                bias, draws, variances = errors(volume, VIEWS, photons, motion, 40)
                said, seen = np.sqrt(variances.mean(0)), draws.std(0)
                ratio = [np.sqrt(np.mean((said / seen)[part] ** 2)) for part in (slice(3), slice(3, 6))]
                values = (
                    *(np.abs(bias[:3]).max(), np.degrees(np.abs(bias[3:]).max()), np.abs(bias / said).max()),
                    *(said[:3].mean(), np.degrees(said[3:].mean()), *ratio),
                )
                name = "none" if not np.any(motion) else "moved"
                row = "{:.4f} | {:.3f} | {:.2f} | {:.4f} | {:.3f} | {:.2f}, {:.2f}".format(*values)
                print(f"| {photons} | {spacing:g} | {name} | {row} |", flush=True)


if __name__ == "__main__":
    main()
