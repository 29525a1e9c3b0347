"""Errors of calibrations from photons that know nothing of the calibration's model: the table of docs/calibrate.md.

    python benchmarks/calibration.py [--draws 20] [--modules 40] [--only WORD]

Photons are drawn one by one: a place in the source, one in the hole, accepted as often as photons go there and pass the
edge; the depth in the crystal at which they stop, a Gaussian's shift, and the pixel in which they then are. Prints the
table.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import mphdrr.core as mph

WORKBOOK = Path(__file__).parents[1] / "examples" / "dc-spect-80.xlsx"
TUNGSTEN, CZT = 3.597, 0.4041  # 1/mm, of 140.5 keV
CASES = {
    "8 points, ± 40 mm": {"blur": 1.0},
    "8 points, ± 40 mm; blur 2 mm": {"blur": 2.0},
    "5 points, ± 43 mm": {"n": 5, "blur": 1.0},
    "5 points, ± 40 mm; blur 2 mm": {"n": 5, "size": 40.0, "blur": 2.0},
    "8 points; blur told as 0 mm": {"blur": 1.0, "told": {"intrinsic_fwhm": 0.0}},
    "8 points; blur told as 3 mm": {"blur": 1.0, "told": {"intrinsic_fwhm": 3.0}},
    "8 balls of 2 mm": {"blur": 1.0, "ball": 2.0, "options": {"source_diameter": 2.0}},
    "8 cubes of 2 mm": {"blur": 1.0, "cube": 2.0, "options": {"source_diameter": 2.58}},
    "8 points; tungsten edge": {"blur": 1.0, "edge_mu": TUNGSTEN, "told": {"aperture_mu": TUNGSTEN, "edge": "path"}},
    "8 points; 10 mm of CZT": {"blur": 1.0, "crystal_mu": CZT, "told": {"crystal_mu": CZT, "depth_layers": 5}},
}
_EDGE_STEPS = 16  # along a photon's path through one half of the plate


def sources(n: int, rng: np.random.Generator, size: float = 40.0) -> np.ndarray:
    """Return n places (n, 3), mm, near the corners of a cube, or five near the middle and four corners."""
    corners = size * np.array(
        [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [1, 1, -1], [-1, -1, -1], [1, -1, 1], [-1, 1, 1]]
    )
    places = corners if n > 5 else np.concatenate([np.zeros((1, 3)), corners])
    return places[:n] + rng.normal(0, 3, (n, 3))


def photon_images(
    system: mph.PinholeSystem, points: np.ndarray, shape: tuple[int, int], rng: np.random.Generator, counts: float = 20_000,
    blur: float = 0.0, ball: float = 0.0, cube: float = 0.0, edge_mu: float = 0.0, crystal_mu: float = 0.0,
) -> np.ndarray:  # fmt: skip
    """Return the counts (K, M, n_v, n_u) of photons, about `counts` in each image; lengths in mm, mu in 1/mm.

    `blur` is the FWHM of the crystals, `ball` a diameter and `cube` a side of the sources; with `edge_mu` photons pass the
    edge, whose cone opens by 90 degrees, and with `crystal_mu` they stop in the crystals' depth.
    """
    images = np.zeros((len(points), len(system), *shape))
    local = np.einsum("mij,kmj->kmi", system.frames(), points[:, None] - system.centers)
    for (k, m), _ in np.ndenumerate(images[..., 0, 0]):
        hole, length = system.pinhole_diameter[m] / 2, system.collimator_length[m]
        reach = 6 * 0.5 / edge_mu if edge_mu else 0.0  # beyond the rim
        more = ((hole + reach) / np.sqrt(hole**2 + hole / edge_mu)) ** 2 if edge_mu else 1.0
        n = rng.poisson(1.02 * more * counts)
        source = local[k, m] + cube * (rng.random((n, 3)) - 0.5)
        if ball:
            direction = rng.normal(size=(n, 3))
            source = (
                source
                + ball / 2 * rng.random((n, 1)) ** (1 / 3) * direction / np.linalg.norm(direction, axis=1)[:, None]
            )
        radius, angle = (hole + reach) * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
        place = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        slope = (source[:, :2] - place) / source[:, 2:]
        secant = np.sqrt(1 + (slope**2).sum(axis=1))
        chance = 1 / (source[:, 2] ** 2 * secant**3)
        chance /= chance.max()
        if edge_mu:
            chance *= np.exp(-edge_mu * _path(place, slope, hole, reach) * secant)
        passed = rng.random(n) < chance
        place, slope, secant = place[passed], slope[passed], secant[passed]
        depth = np.zeros(len(place))
        if crystal_mu:
            rate = crystal_mu * secant
            depth = -np.log1p(rng.random(len(place)) * np.expm1(-rate * system.detector_thickness[m])) / rate
        recorded = slope * (length + depth)[:, None] - place + blur / 2.3548 * rng.normal(size=place.shape)
        u, v = np.floor((recorded / system.detector_side[m] + 0.5) * shape[::-1]).astype(int).T
        inside = (u >= 0) & (u < shape[1]) & (v >= 0) & (v < shape[0])
        pixels = shape[1] * v[inside] + u[inside]
        images[k, m] = np.bincount(pixels, minlength=shape[0] * shape[1]).reshape(shape)
    return images


def _path(place: np.ndarray, slope: np.ndarray, hole: float, reach: float) -> np.ndarray:
    """Return the lengths along the axis, mm, in the edge of a 90 degree cone, of photons through `place` (n, 2)."""
    lengths, beyond = np.zeros(len(place)), (place**2).sum(axis=1) > hole**2  # others with slopes below 1 never meet it
    (x, y), (a, b), step = place[beyond].T, slope[beyond].T, reach / _EDGE_STEPS
    for z in step * (np.arange(-_EDGE_STEPS, _EDGE_STEPS) + 0.5):
        lengths[beyond] += step * ((x - z * a) ** 2 + (y - z * b) ** 2 > (hole + abs(z)) ** 2)
    return lengths


def misaligned(nominal: mph.PinholeSystem, rng: np.random.Generator) -> mph.PinholeSystem:
    """Return the scanner with its pinholes off by 1 mm along each axis and its modules tilted by 0.5 degrees about each."""
    shifts, tilts = rng.normal(0, 1, (2, len(nominal), 3))
    return nominal.replace(centers=nominal.centers + shifts, tilt=nominal.tilt + np.radians(0.5) * tilts)


def errors(found: mph.Calibration, true: mph.PinholeSystem) -> np.ndarray:
    """Return the errors (M, 6) that the covariance is of, after the true scanner was moved as a whole by the gauge."""
    nominal, used = found.nominal, found.used.any(axis=0)
    if found.gauge:
        middle, goal = (system.centers[used].mean(axis=0) for system in (true, nominal))
        apart, wanted = true.centers - middle, nominal.centers[used] - goal
        u, _, vt = np.linalg.svd(wanted.T @ apart[used])
        turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        turned = apart @ turn.T
        scale = (wanted**2).sum() / (wanted * turned[used]).sum() if "scale" in found.gauge else 1.0
        poses = np.tile(np.eye(4), (len(true), 1, 1))
        poses[:, :3, :3] = (true.frames() @ turn.T).swapaxes(1, 2)
        poses[:, :3, 3] = goal + scale * turned
        true = true.at_poses(poses)
    shifts = np.einsum("mij,mj->mi", found.system.frames(), found.system.centers - true.centers)
    return np.concatenate([shifts, found.system.tilt - true.tilt], axis=1)


def consistency(found: mph.Calibration, true: mph.PinholeSystem) -> np.ndarray:
    """Return the errors' square over their stated covariance, per number, of each module (M,)."""
    off = errors(found, true)
    return np.einsum("mi,mij,mj->m", off, np.linalg.inv(found.covariance), off) / 6


def calibration(
    nominal: mph.PinholeSystem, rng: np.random.Generator, n: int = 8, size: float = 0.0, shape: tuple[int, int] = (64, 64),
    told: dict[str, Any] | None = None, options: dict[str, Any] | None = None, **physics: float,
) -> tuple[mph.Calibration, mph.PinholeSystem]:  # fmt: skip
    """Return a calibration from n sources, and the true scanner. `told` changes what the model says of the physics."""
    true = misaligned(nominal, rng)
    images = photon_images(true, sources(n, rng, size or (43.0 if n < 8 else 40.0)), shape, rng, **physics)
    model = mph.Emission(nominal, **{"intrinsic_fwhm": physics["blur"], **(told or {})})
    return mph.calibrate(nominal, images, nominal.views(shape), model=model, **(options or {})), true


def main() -> None:
    """Print the rows of the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--modules", type=int, default=40)
    parser.add_argument("--only", default="", help="cases with this word")
    arguments = parser.parse_args()
    whole = mph.read_system(WORKBOOK)
    nominal = whole[np.linspace(0, len(whole) - 1, arguments.modules).round().astype(int)]
    print("| case | across k, mm | along k, mm | tilt about u, v | about k | consistency | chi-square | blur, mm |")
    print("|---|---|---|---|---|---|---|---|")
    for name, case in CASES.items():
        if arguments.only not in name:
            continue
        squares, ratios, chi_squares, blurs = [], [], [], []
        for seed in range(arguments.draws):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", mph.InputWarning)
                found, true = calibration(nominal, np.random.default_rng(seed), **case)
            squares.append((errors(found, true) ** 2).mean(axis=0))
            ratios.append(consistency(found, true).mean())
            chi_squares.append(np.nanmean(found.chi_square))
            blurs.append(found.blur.mean())
        u, v, k, *tilts = np.sqrt(np.mean(squares, axis=0))
        turns = np.degrees(tilts)
        columns = (
            f"{np.hypot(u, v) / 2**0.5:.3f}",
            f"{k:.3f}",
            f"{np.hypot(*turns[:2]) / 2**0.5:.3f}°",
            f"{turns[2]:.3f}°",
        )
        ratio = f"{np.mean(ratios):.2f} | {np.mean(chi_squares):.2f} | {np.mean(blurs):.3f} ± {np.std(blurs):.3f}"
        print(f"| {name} | {' | '.join(columns)} | {ratio} |", flush=True)


if __name__ == "__main__":
    main()
