"""What 24 stationary X-ray sources see: TV, SIRT, OSTR and FDK, each as strong and as long as is best on other bodies.

    python examples/xray_study.py [--bodies 4] [--picture study.png]

It makes the tables of docs/xray.md, in about five minutes on two free cores. Images are made from voxels half as large as
those that are reconstructed, with Poisson noise. Strengths and numbers of iterations are chosen on two bodies that are not
in the table. All errors are root mean squares within a ball of 60 mm, relative to the rms of the truth.
"""

from __future__ import annotations

import argparse
import warnings

import numpy as np

import mphdrr.core as mph

PHOTONS = 1e4  # of a pixel without a body, at dose 1
VOXELS, SPACING = 40, 3.5
ROI = 60.0  # mm
GRID = mph.Grid.centered(VOXELS, SPACING)
FINE = mph.Grid.centered(2 * VOXELS, SPACING / 2)
DISTANCE = np.linalg.norm(np.stack(np.meshgrid(*[SPACING * (np.arange(VOXELS) - (VOXELS - 1) / 2)] * 3)), axis=0)
INSIDE = DISTANCE < ROI
STEP, MOST = 10, 200  # iterations: results are compared after every tenth
STRENGTHS = {
    "TV": (0.1, 0.3, 1.0),
    "SIRT": (None,),
    "OSTR": (2e3, 1e4),
    "FDK": ("ramp", "cosine", "hann"),
}

Found = dict[int, np.ndarray]  # iterations -> values


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bodies", type=int, default=4, help="bodies of the table")
    parser.add_argument("--picture", help="write slices of the first body (.webp)")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", mph.InputWarning)  # FDK says that the arc is too short, which is what is studied
    arrangements = {"arc": mph.xray_arc(shape=(64, 64)), "ring": mph.xray_ring(shape=(64, 64))}
    shown: list[np.ndarray] = []
    print("| sources | dose | method | best on validation | error | where seen | where unseen |")
    print("|---|---|---|---|---|---|---|")
    for name, system in arrangements.items():
        views, seen = system.views(), seen_directions(system)
        for dose in (1.0, 0.25):
            for method in STRENGTHS:
                strength, iterations = best(method, views, dose)
                errors = []
                for seed in range(arguments.bodies):
                    truth, images = measured(views, seed, dose)
                    values = run(method, views, images, strength, dose, iterations)[iterations]
                    errors.append([error(values, truth), *errors_by_direction(values, truth, seen)])
                    if seed == 0 and dose == 1:
                        shown += [truth.array] * (not shown) + [values]
                chosen = ", ".join(str(x) for x in (strength, f"{iterations} iterations" if iterations else None) if x)
                numbers = " | ".join(f"{x:.3f}" for x in np.mean(errors, axis=0))
                print(f"| {name} | {dose:g} | {method} | {chosen} | {numbers} |", flush=True)
        share = float(np.mean(seen[_ring_of_frequencies()]))
        print(f"\nThe {name} meets {share:.0%} of the planes through the isocentre.\n", flush=True)
    misaligned(arrangements["arc"], arguments.bodies)
    if arguments.picture:
        picture(shown, arguments.picture)


def body(seed: int) -> mph.ShapePhantom:
    """Return an ellipsoid of tissue that contains fat, air, muscle, iodine and bone; mu at 60 keV."""
    rng = np.random.default_rng(seed)
    shapes = [mph.Ellipsoid(radii=(62, 58, 54), mu=0.0206)]
    for mu in (0.0185, 0.0055, 0.0217, 0.03, 0.045, 0.0185, 0.0217, 0.0055):
        turn = rng.uniform(0, 2 * np.pi, 3)
        shapes.append(mph.Ellipsoid(radii=rng.uniform(5, 16, 3), position=rng.uniform(-28, 28, 3), euler=turn, mu=mu))
    return mph.ShapePhantom(shapes)


def measured(views: mph.Views, seed: int, dose: float) -> tuple[mph.Volume, np.ndarray]:
    """Return the truth on the reconstruction's voxels, and line integrals from voxels half as large, with noise."""
    fine = body(seed).voxelize(FINE, quantity="mu")
    photons = dose * PHOTONS
    passed = photons * np.exp(-np.asarray(mph.Projector(FINE, views)(fine)))
    counts = mph.sample_counts(passed, seed + 1000)
    return mph.resample(fine, GRID, "mean"), np.log(photons / np.maximum(counts, 0.5))


def run(
    method: str, views: mph.Views, images: np.ndarray, strength: float | str | None, dose: float, iterations: int
) -> Found:
    """Reconstruct; return the values by number of iterations, which is 0 for FDK."""
    if method == "FDK":
        return {0: mph.fdk(images, views, GRID, str(strength)).array}
    A, found = mph.Projector(GRID, views), Found()

    def keep(done: int, values: np.ndarray) -> None:
        if done % STEP == 0:
            found[done] = values.copy()

    if method == "SIRT":
        mph.sirt(A, images, iterations, relaxation=1.9, callback=keep)
    elif method == "TV":
        mph.tv(A, images, strength, iterations, callback=keep)
    else:
        prior = mph.TotalVariation(dose * strength, edge=1e-4)
        mph.ostr(A, images, iterations, prior=prior, photons=dose * PHOTONS, callback=keep)
    return found


def best(method: str, views: mph.Views, dose: float) -> tuple[float | str | None, int]:
    """Return the strength and the number of iterations with the least mean error of two bodies."""
    scores: dict[tuple[float | str | None, int], float] = {}
    for strength in STRENGTHS[method]:
        for seed in (100, 101):
            truth, images = measured(views, seed, dose)
            for done, values in run(method, views, images, strength, dose, 40 if method == "OSTR" else MOST).items():
                scores[strength, done] = scores.get((strength, done), 0.0) + error(values, truth)
    return min(scores, key=scores.__getitem__)


def error(values: np.ndarray, truth: mph.Volume) -> float:
    """Return the NRMSE within the ball."""
    return mph.nrmse(values, truth.array, INSIDE)


def _frequencies() -> np.ndarray:
    return np.stack(np.meshgrid(*[np.fft.fftfreq(VOXELS, SPACING)] * 3, indexing="ij"), axis=-1)


def _ring_of_frequencies() -> np.ndarray:
    """Return the mask of the frequencies of details of 8 to 40 mm."""
    size = np.linalg.norm(_frequencies(), axis=-1)
    return (size > 1 / 40) & (size < 1 / 8)


def seen_directions(system: mph.XraySystem) -> np.ndarray:
    """Return the mask of frequencies whose plane through the isocentre meets the arc of sources (Tuy's condition)."""
    sides = _frequencies() @ (system.sources / np.linalg.norm(system.sources, axis=1)[:, None]).T
    return (sides.min(axis=-1) <= 0) & (sides.max(axis=-1) >= 0)


def errors_by_direction(values: np.ndarray, truth: mph.Volume, seen: np.ndarray) -> list[float]:
    """Return the errors of details of 8 to 40 mm in directions that the sources see, and in the others."""
    inside = np.clip((ROI - DISTANCE) / 10, 0, 1)
    wanted, wrong = (np.abs(np.fft.fftn(inside * x)) for x in (truth.array, values - truth.array))
    parts = (_ring_of_frequencies() & which for which in (seen, ~seen))
    return [float(np.linalg.norm(wrong[part]) / np.linalg.norm(wanted[part])) for part in parts]


def misaligned(system: mph.XraySystem, bodies: int) -> None:
    """Print the errors for panels displaced by 1 mm, reconstructed with the true matrices and with the nominal ones."""
    angle = np.random.default_rng(5).uniform(0, 2 * np.pi, len(system))[:, None]
    u, v = (x / np.linalg.norm(x, axis=1)[:, None] for x in (system.panel_u, system.panel_v))
    true = system.replace(panel_centers=system.panel_centers + np.cos(angle) * u + np.sin(angle) * v)
    print("| panels | method | error |\n|---|---|---|")
    for method in ("TV", "SIRT"):
        strength, iterations = best(method, system.views(), 1.0)
        for name, made, used in (
            ("where they should be", system, system),
            ("1 mm beside, true matrices", true, true),
            ("1 mm beside, drawn matrices", true, system),
        ):
            errors = []
            for seed in range(bodies):
                truth, images = measured(made.views(), seed, 1.0)
                errors.append(error(run(method, used.views(), images, strength, 1.0, iterations)[iterations], truth))
            print(f"| {name} | {method} | {np.mean(errors):.4f} |", flush=True)


def picture(shown: list[np.ndarray], path: str, height: int = 240) -> None:
    """Draw slices across z and across x: the truth, then each method from the arc and from the ring."""
    from PIL import Image

    truth, *others = shown
    half = len(others) // 2
    at = VOXELS // 2
    rows = [
        np.hstack([x.take(at, axis).T[::-1] for x in (truth, *row)])
        for row in (others[:half], others[half:])
        for axis in (2, 0)
    ]
    grey = np.clip(np.vstack(rows) / 0.04 * 255, 0, 255).astype(np.uint8)
    size = (height * (half + 1), height * len(rows))
    Image.fromarray(grey).resize(size, Image.Resampling.BICUBIC).save(path)


if __name__ == "__main__":
    main()
