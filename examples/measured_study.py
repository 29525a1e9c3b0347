"""A scan as a real scanner makes it, with all its faults, and what each correction of them is worth.

    python examples/measured_study.py [FOLDER] [--picture study.webp] [--modules 80] [--pixels 32]

It writes into FOLDER what a scanner gives: a scan and the flood of an even source, as DICOM NM and as Interfile, and beside
them attenuation, the scanner's workbook and one recipe, study.toml. Then it does what docs/measured-studies.md does by
commands, and prints the table there. The scanner's modules measure one after another, each ring for another time; a module
is dead, and so are some pixels, while others are hot; no pixel counts like the next; all are busy for a while after each
photon, and a quarter of the photons were scattered in the water. It takes a minute or two.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import mphdrr.core as mph
from mphdrr.core.figures.page import Page
from mphdrr.core.figures.parts import INK
from mphdrr.core.runs.display import Display

WORKBOOK = Path(__file__).with_name("dc-spect-80.xlsx")
ACTIVITY, RADIUS, HEIGHT = 200.0, 55.0, 100.0  # kBq/mL, mm: a cylinder of water
MIDDLE = 20.0  # mm, of the ball in which volumes are compared
WINDOWS = ((120.0, 126.0), (126.0, 154.0), (154.0, 160.0))  # keV: lower, peak, upper
START, DURATIONS, PAUSE = 10_800.0, (300.0, 900.0, 450.0, 750.0), 1200.0  # s; the rings follow each other
DEAD_TIME = 200e-6  # s: as of crystals that are read out pixel by pixel
SCATTER = 1 / 3  # in the peak's window, of the other photons
HOT = 20.0  # counts per second of a hot pixel in the peak's window
FLOOD, FLOOD_TIME = 10_000.0, 600.0  # counts of a pixel, s
PHYSICS = {"isotope": "Tc-99m", "aperture_mu": "tungsten", "crystal_mu": "CZT", "intrinsic_fwhm": 1.6}
ALL = "all corrections"

RECIPE = """\
[system]
file = "scanner.xlsx"

[counts]
files = ["scan.dcm"]
frames = "none*{count}, 1-{count}, none*{count}"
lower_frames = "1-{count}, none*{twice}"
upper_frames = "none*{twice}, 1-{count}"
orientation = "back-v"
scatter_fwhm = 4.0                # pixels

[attenuation]
file = "water.nii.gz"

[model]
kind = "emission"
isotope = "Tc-99m"
start = {start}                   # s: when the first frame began, after the activity's reference time
efficiency = "efficiency.npy"
dead_time = {dead_time}                 # µs
aperture_mu = "tungsten"
crystal_mu = "CZT"
intrinsic_fwhm = 1.6              # mm

[reconstruction]
iterations = 5
subsets = 8
voxels = 32
spacing = 5.0                     # mm
"""


def main() -> None:
    """Write the study's files, reconstruct it with and without each correction, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", default="measured_study", help="where the files are written")
    parser.add_argument("--picture", help="write slices of some volumes (.webp)")
    parser.add_argument("--modules", type=int, default=80, help="how many of the scanner's")
    parser.add_argument("--pixels", type=int, default=32, help="of a module's image, along a side")
    arguments = parser.parse_args()
    began, folder = time.perf_counter(), Path(arguments.folder)
    write_study(folder, arguments.modules, arguments.pixels)
    print(f"{folder}: written, {time.perf_counter() - began:.0f} s")
    volumes = reconstructed(folder)
    print_table(volumes)
    print(f"{time.perf_counter() - began:.0f} s")
    if arguments.picture:
        draw(volumes, arguments.picture)


def write_study(folder: Path, modules: int = 80, pixels: int = 32, seed: int = 1) -> None:
    """Simulate the scan and the flood, and write into `folder` what a scanner and its user have."""
    folder.mkdir(parents=True, exist_ok=True)
    rng, system = np.random.default_rng(seed), mph.read_system(WORKBOOK)
    system = system[np.linspace(0, len(system) - 1, modules).round().astype(int)]
    system = system.replace(numbers=np.arange(1, modules + 1))
    mph.write_system(system, folder / "scanner.xlsx")
    texts = {"count": modules, "twice": 2 * modules, "start": START, "dead_time": 1e6 * DEAD_TIME}
    (folder / "study.toml").write_text(RECIPE.format(**texts), encoding="utf-8")

    # What the modules would count in a second at the reference time, had they no faults.
    fine = mph.Grid.centered(64, 2.5)
    water = mph.ShapePhantom([mph.Cylinder(radius=RADIUS, height=HEIGHT, activity=ACTIVITY, mu=0.0154)])
    mu = water.voxelize(fine, quantity="mu")
    mph.write_volume(mu, folder / "water.nii.gz")
    model = mph.Emission(system, time=1.0, mu=mu, **PHYSICS)
    A = mph.Projector(fine, system.views((pixels, pixels), "real"), model)
    rates = np.asarray(A(water.voxelize(fine)), float) / model.effective_time

    # When they measure, and their efficiencies. A flood leaves open how modules differ, so here they do not.
    ring = np.arange(modules) * len(DURATIONS) // modules
    times, starts = np.array(DURATIONS)[ring], (np.cumsum([0, *DURATIONS[:-1]]) + PAUSE * np.arange(4))[ring]
    efficiency, dead, hot = pixels_of(rates.shape, rng)
    decayed = mph.Emission(system, isotope="Tc-99m", time=times, start=START + starts).effective_time
    scan = counted(rates, decayed, times, efficiency, hot, rng)
    write_dicom(folder / "scan.dcm", scan, times, starts)
    write_interfile(folder / "scan.hdr", scan, times, starts)
    np.savez(folder / "truth.npz", times=times, starts=starts, efficiency=efficiency, dead=dead, hot=hot)

    # The flood: a source so far from the bare crystals that it shines evenly on them.
    flood = rng.poisson(FLOOD * efficiency + FLOOD_TIME * HOT * hot)
    for write, name in ((write_dicom, "flood.dcm"), (write_interfile, "flood.hdr")):
        write(folder / name, [flood], np.full(modules, FLOOD_TIME), np.zeros(modules))

    # The same study without these faults: at the reference time, all modules for the same time.
    second = mph.Emission(system, isotope="Tc-99m", time=times.mean()).effective_time
    np.save(folder / "faultless.npy", rng.poisson(rates * second))


def pixels_of(shape: tuple[int, ...], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw the pixels' efficiencies, 0 where dead, and masks of the dead and of the hot ones (M, n_v, n_u).

    Crystals count less at the edges, and pixels differ by 4 %. Dead are one pixel in 200 and one module, hot one in 300.
    """
    v, u = (np.linspace(-1, 1, n) for n in shape[1:])
    efficiency = (1 - 0.1 * (v[:, None] ** 2 + u**2)) * rng.normal(1, 0.04, shape)
    chance = rng.random(shape)
    dead, hot = chance < 1 / 200, chance > 1 - 1 / 300
    dead[shape[0] // 3], hot[shape[0] // 3] = True, False
    efficiency[dead] = 0
    lives = ~dead & ~hot
    mean = (efficiency * lives).sum((1, 2)) / np.maximum(lives.sum((1, 2)), 1)
    return efficiency / np.where(mean > 0, mean, 1)[:, None, None], dead, hot


def counted(
    rates: np.ndarray,
    seconds: np.ndarray,
    times: np.ndarray,
    efficiency: np.ndarray,
    hot: np.ndarray,
    rng: np.random.Generator,
) -> list[np.ndarray]:
    """Draw the counts of the three windows: unscattered and scattered photons, hot pixels, dead time, and noise.

    The scattered ones are a continuum that falls linearly with the energy, of images smeared over a quarter of the crystal.
    """
    primary = rates * seconds[:, None, None]
    smear = gaussian(rates.shape[1], rates.shape[1] / 4), gaussian(rates.shape[2], rates.shape[2] / 4)
    scatter = SCATTER * smear[0] @ primary @ smear[1].T
    (low, high), middles = WINDOWS[1], [(a + b) / 2 for a, b in WINDOWS]
    density = [(1 - 0.02 * (middle - middles[1])) / (high - low) for middle in middles]
    expected = [scatter * d * (b - a) for d, (a, b) in zip(density, WINDOWS, strict=True)]
    expected[1] = expected[1] + primary
    own = HOT * hot * times[:, None, None]
    expected = [efficiency * x + own * (b - a) / (high - low) for x, (a, b) in zip(expected, WINDOWS, strict=True)]
    total = sum(x.sum((1, 2)) for x in expected)  # a photon of any window keeps the module busy
    live = 1 / (1 + DEAD_TIME * total / times)
    return [rng.poisson(x * live[:, None, None]) for x in expected]


def gaussian(count: int, fwhm: float) -> np.ndarray:
    """Return the matrix that smears `count` pixels along an axis."""
    apart = np.subtract.outer(np.arange(count), np.arange(count))
    weights = np.exp(-4 * np.log(2) * (apart / fwhm) ** 2)
    return weights / weights.sum(axis=0)


def write_dicom(path: Path, windows: list[np.ndarray], times: np.ndarray, starts: np.ndarray) -> None:
    """Write the frames of each energy window, module by module, as a DICOM file.

    Modules that measure together are a phase (DICOM part 3, C.8.4).
    """
    import pydicom.uid
    from pydicom.dataset import Dataset, FileMetaDataset

    frames = np.concatenate(windows)
    count, modules = len(windows), len(times)
    data = Dataset()
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = pydicom.uid.NuclearMedicineImageStorage
    data.SOPInstanceUID = data.file_meta.MediaStorageSOPInstanceUID = pydicom.uid.generate_uid()
    data.Modality, data.ImageType = "NM", ["ORIGINAL", "PRIMARY", "DYNAMIC", "EMISSION"]
    data.AcquisitionDate, data.AcquisitionTime = "20260302", "113000"
    begun, phase = np.unique(starts, return_inverse=True)
    lasted = [times[phase == k][0] for k in range(len(begun))]
    ended = np.concatenate([[0], (begun + lasted)[:-1]])
    data.PhaseInformationSequence = [Dataset() for _ in begun]
    for part, start, duration, before in zip(data.PhaseInformationSequence, begun, lasted, ended, strict=True):
        part.PhaseDelay, part.ActualFrameDuration = round(1000 * (start - before)), round(1000 * duration)  # ms
        part.NumberOfFramesInPhase, part.PauseBetweenFrames = 1, 0
    edges = WINDOWS if count == 3 else WINDOWS[1:2]
    data.EnergyWindowInformationSequence = [Dataset() for _ in windows]
    for window, (low, high) in zip(data.EnergyWindowInformationSequence, edges, strict=True):
        span = Dataset()
        span.EnergyWindowLowerLimit, span.EnergyWindowUpperLimit = low, high
        window.EnergyWindowRangeSequence = [span]
    data.NumberOfEnergyWindows, data.NumberOfDetectors, data.NumberOfPhases = count, modules, len(begun)
    data.FrameIncrementPointer = [0x00540010, 0x00540020, 0x00540100]
    data.EnergyWindowVector = np.repeat(np.arange(count) + 1, modules).tolist()
    data.DetectorVector = np.tile(np.arange(modules) + 1, count).tolist()
    data.PhaseVector = np.tile(phase + 1, count).tolist()
    data.NumberOfFrames, data.Rows, data.Columns = frames.shape
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 0
    data.PixelData = stored(frames).tobytes()
    data.save_as(path, enforce_file_format=True)


def write_interfile(path: Path, windows: list[np.ndarray], times: np.ndarray, starts: np.ndarray) -> None:
    """Write the frames of each energy window as an Interfile header and a file of numbers."""
    frames, count = np.concatenate(windows), len(windows)
    edges = WINDOWS if count == 3 else WINDOWS[1:2]
    lines = ["!INTERFILE :=", "!imaging modality := nucmed", f"!name of data file := {path.with_suffix('.img').name}"]
    lines += [f"!total number of images := {len(frames)}", "imagedata byte order := LITTLEENDIAN"]
    lines += [f"!matrix size [1] := {frames.shape[2]}", f"!matrix size [2] := {frames.shape[1]}"]
    lines += ["!number format := unsigned integer", "!number of bytes per pixel := 2"]
    lines += [f"number of energy windows := {count}"]
    for number, (low, high) in enumerate(edges, 1):
        lines += [f"energy window lower level [{number}] := {low}", f"energy window upper level [{number}] := {high}"]
    for duration, start in zip(np.tile(times, count), np.tile(starts, count), strict=True):
        lines += [f"!image duration (sec) := {duration}", f"image relative start time (sec) := {start}"]
    path.write_text("\n".join([*lines, "!END OF INTERFILE :=", ""]), encoding="ascii")
    path.with_suffix(".img").write_bytes(stored(frames).tobytes())


def stored(frames: np.ndarray) -> np.ndarray:
    """Return the counts as unsigned 16-bit integers."""
    if frames.max() > 65535:
        raise ValueError(f"{frames.max()} counts in a pixel are more than two bytes hold")
    return frames.astype("<u2")


def reconstructed(folder: Path) -> dict[str, mph.Volume]:
    """Return volumes by the table's rows: without faults, by the recipe, and with each correction left out in turn."""
    recipe = mph.read_recipe(folder / "study.toml")
    find_efficiency(folder, recipe)
    found = {"without faults": reconstruct(recipe.updated(faultless(folder, recipe)))}
    for name, changes in left_out(folder, recipe).items():
        found[name] = reconstruct(recipe.updated(changes))
    return found


def find_efficiency(folder: Path, recipe: mph.Recipe) -> None:
    """Compute the efficiencies from the flood, as `mphdrr project --counts flood.dcm` and `mphdrr counts flood` do."""
    bare = {key: None for key in recipe.given if not key.startswith(("system.", "model.kind", "counts.orientation"))}
    said = {"counts.files": [str(folder / "flood.dcm")], "counts.frames": frames_of(folder)}
    (flood,) = runs_of(recipe.updated(bare | said))
    found = mph.flood_efficiency(flood.projections, smooth_order=0)
    print(found)
    np.save(folder / "efficiency.npy", found.efficiency.astype(np.float32))
    np.save(folder / "levelled.npy", mph.flood_efficiency(flood.projections).efficiency)


def frames_of(folder: Path) -> str:
    """Return the module numbers of the frames of a file with one energy window."""
    return f"1-{len(mph.read_system(folder / 'scanner.xlsx'))}"


def faultless(folder: Path, recipe: mph.Recipe) -> dict[str, Any]:
    """Return the changes of the recipe for the study without faults."""
    plain = {key: None for key in recipe.given if key.startswith("counts.") and key != "counts.orientation"}
    plain |= dict.fromkeys(("model.efficiency", "model.dead_time", "model.start"))
    files, seconds = [str(folder / "faultless.npy")], float(np.load(folder / "truth.npz")["times"].mean())
    return plain | {"counts.files": files, "counts.frames": frames_of(folder), "model.time": seconds}


def left_out(folder: Path, recipe: mph.Recipe) -> dict[str, dict[str, Any]]:
    """Return the changes of the recipe by rows: none, Interfile instead of DICOM, and without a correction each."""
    efficiency, levelled = (np.load(folder / f"{name}.npy") for name in ("efficiency", "levelled"))
    gone = np.zeros_like(efficiency) + ~efficiency.any((1, 2), keepdims=True)
    several = {
        "no_map": efficiency > 0,
        "no_edges": levelled,
        "no_pixels": np.where((efficiency == 0) & (gone == 0), 1, efficiency),
        "no_module": efficiency + gone,
    }
    for name, array in several.items():
        np.save(folder / f"{name}.npy", array.astype(np.float32))
        several[name] = {"model.efficiency": str(folder / f"{name}.npy")}
    # Frames of a file that says nothing: the files' own times are not contradicted without a word.
    counts = mph.read_counts(folder / "scan.dcm")
    np.save(folder / "scan.npy", np.asarray(counts))
    truth = np.load(folder / "truth.npz")
    silent: dict[str, Any] = {
        "counts.files": [str(folder / "scan.npy")],
        "counts.window_widths": [high - low for low, high in WINDOWS],
        "model.time": truth["times"].tolist(),
        "model.start": (START + truth["starts"]).tolist(),
    }
    scatter = dict.fromkeys(("counts.lower_frames", "counts.upper_frames", "counts.scatter_fwhm"))
    return {
        ALL: {},
        "all, from Interfile": {"counts.files": [str(folder / "scan.hdr")]},
        "exposures": silent | {"model.time": float(truth["times"].mean())},
        "starts": silent | {"model.start": START},
        "decay before the scan": silent | {"model.start": truth["starts"].tolist()},
        "dead module": several["no_module"],
        "dead and hot pixels": several["no_pixels"],
        "efficiencies of the others": several["no_map"],
        "efficiencies' smooth part": several["no_edges"],
        "dead time": {"model.dead_time": None},
        "scatter": scatter,
        "attenuation": {"attenuation.file": None},
    }


def runs_of(recipe: mph.Recipe) -> list[Any]:
    """Return the recipe's runs without warnings, such as those of dead pixels, which the study is about."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mph.InputWarning)
        return list(mph.run_recipe(recipe))


def reconstruct(recipe: mph.Recipe) -> mph.Volume:
    """Import and reconstruct by one recipe."""
    (run,) = runs_of(recipe)
    return mph.reconstruct_run(run, recipe).volume


def middle(volume: mph.Volume) -> np.ndarray:
    """Return the values within the ball in the middle."""
    axes = (np.arange(n) - (n - 1) / 2 for n in volume.grid.shape)
    squares = [(x * step) ** 2 for x, step in zip(axes, volume.grid.spacing, strict=True)]
    return volume.array[np.add.outer(np.add.outer(squares[0], squares[1]), squares[2]) < MIDDLE**2]


def numbers_of(volumes: Mapping[str, mph.Volume]) -> dict[str, tuple[float, float, float, float]]:
    """Return four numbers of each row, from the voxels in the middle.

    The mean; and, relative to means: the difference from the volume without faults, the standard deviation, and the root
    mean square difference from the volume with all corrections.
    """
    right, best = middle(volumes["without faults"]).mean(), middle(volumes[ALL])
    found = {}
    for name, volume in volumes.items():
        values = middle(volume)
        mean, other = values.mean(), np.sqrt(np.mean((values - best) ** 2)) / best.mean()
        found[name] = float(mean), float(mean / right - 1), float(values.std() / mean), float(other)
    return found


def print_table(volumes: Mapping[str, mph.Volume]) -> None:
    """Print the numbers of all rows in Markdown."""
    print("| | mean, kBq/mL | off by | standard deviation | voxels changed by |\n|---|---|---|---|---|")
    for name, (mean, off, deviation, other) in numbers_of(volumes).items():
        changed = "–" if name in ("without faults", ALL) else f"{other:.1%}"
        print(f"| {name} | {mean:.1f} | {off:+.1%} | {deviation:.1%} | {changed} |".replace("-", "−"), flush=True)


def draw(volumes: Mapping[str, mph.Volume], path: str) -> None:
    """Draw slices along the cylinder in the same colors: without faults, with all corrections, each correction left out."""
    from PIL import Image

    display, side, gap = Display(colors="inferno"), 200, 10
    shown = [name for name in volumes if name not in ("all, from Interfile", "decay before the scan")]
    columns = (len(shown) + 1) // 2
    page = Page(columns * (side + gap) + gap, 2 * (side + 4 * gap))
    for number, name in enumerate(shown):
        row, column = divmod(number, columns)
        left, top = gap + column * (side + gap), 3 * gap + row * (side + 4 * gap)
        array = volumes[name].array
        page.image(display.colored(array[:, array.shape[1] // 2].T[::-1], (0.0, 1.5 * ACTIVITY)), left, top, side, side)
        page.text(name if number < 2 else f"no: {name}", left + side / 2, top - 0.7 * gap, 13, INK, "middle")
    Image.fromarray(page.picture).save(path, quality=80)


if __name__ == "__main__":
    main()
