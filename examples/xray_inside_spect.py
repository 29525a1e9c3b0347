"""Two imaging chains in one room: X-ray CT above the modules, its attenuation for SPECT, the dose, and motion.

    python examples/xray_inside_spect.py [FOLDER]

24 X-ray sources on a ring see a torso, with its heart at the isocentre of the pinhole modules. From their counts: the CT;
its attenuation at 140.5 keV; SPECT with it, with the true one and with none; the dose of the activity, and that of the CT.
Then the patient moves by 5 mm and 3 degrees, which 24 radiographs show. Takes about two minutes; with FOLDER it writes
both.xlsx, volumes and a picture.
"""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import Path

import numpy as np

import mphdrr.core as mph
from mphdrr.core.geometry.frames import affine_matrix, rotations

HERE = Path(__file__).parent
MIDDLE = (35.0, -30.0, -30.0)  # of the torso, whose heart is at the isocentre, mm
FINE, COARSE = mph.Grid.centered((88, 64, 112), 4.0, MIDDLE), mph.Grid.centered((44, 32, 56), 8.0, MIDDLE)
SECONDS = 600.0  # of SPECT


def main(folder: Path | None) -> None:
    """Run the study, and print its results."""
    warnings.simplefilter("ignore", mph.InputWarning)
    begun = time.monotonic()
    pinholes = mph.read_system(HERE / "dc-spect-80.xlsx")[::2]  # half of them, in half the time
    # Panels so wide that each source sees the whole torso: an arc or narrower panels do not tell its attenuation.
    xray = mph.xray_ring(source_radius=600, panel_size=(800, 600), shape=(96, 128), kvp=120, mas=0.5)
    torso = mph.CardiacTorso()
    activity = torso.voxelize(FINE)
    ct = mph.mu_to_hu(torso.voxelize(FINE, quantity="mu"), torso.mu_energy)
    mu = mph.hu_to_mu(ct)

    # CT: counts at 120 kV behind water and bone become paths through water, and these CT numbers.
    counter = mph.SpectralTransmission(xray, mph.tube_spectrum(120).coarser(4), ("water", "bone"), ((20, 120),))
    water = mph.SpectralTransmission(xray, mph.tube_spectrum(120).coarser(4), ("water",), ((20, 120),))

    def line_integrals(volume: mph.Volume, seed: int) -> np.ndarray:
        """Return mu of water at 70 keV times the path through water that the CT derives from its counts, for each ray."""
        expected = counter.project(mph.water_and_bone(volume), mph.Projector(volume.grid, xray.views()), xray.mas)
        counts = mph.sample_counts(np.moveaxis(expected, 0, 1), seed)
        return mph.correct_beam_hardening(np.moveaxis(counts, 1, 0), water, xray.mas) * mph.attenuation("water", 70.0)

    A = mph.Projector(COARSE, xray.views())
    radiographs = line_integrals(ct, 1)
    outline = torso.voxelize(COARSE, quantity="mu").array > 0.002  # as a camera would see it
    found = mph.tv(A, radiographs, weight=0.5, iterations=120, mask=outline).volume
    mu_found = mph.hu_to_mu(mph.mu_to_hu(found, 70.0))
    kerma = mph.isocentre_kerma(xray).sum()
    print(f"CT: {kerma:.0f} µGy of air kerma at the isocentre; {time.monotonic() - begun:.0f} s")

    # SPECT, attenuated as in truth, and reconstructed with what is known.
    views = pinholes.views((32, 32), magnification=1.0)

    def projector(grid: mph.Grid, mu: mph.Volume | None) -> mph.Projector:
        return mph.Projector(grid, views, mph.Emission(pinholes, mu=mu, isotope="Tc-99m", time=SECONDS))

    counts = mph.sample_counts(projector(FINE, mu)(activity), 2)
    maps = {"true mu": mu, "mu of the CT": mu_found, "no mu": None}
    spect = {name: mph.osem(projector(COARSE, known), counts, 4, 8).volume for name, known in maps.items()}
    heart = mph.resample(activity, COARSE, "mean").array > 45
    means = {name: float(volume.array[heart].mean()) for name, volume in spect.items()}
    for name, mean in means.items():
        print(f"SPECT with {name}: {mean:.1f} kBq/mL in the heart, {mean / means['true mu'] - 1:+.1%}")
    print(f"{time.monotonic() - begun:.0f} s")

    density = np.maximum(1 + mph.mu_to_hu(found, 70.0).array / 1000, 0.05)  # g/cm^3, nearly
    rate = mph.absorbed_dose_rate(spect["mu of the CT"], "Tc-99m", density)
    dose = mph.absorbed_dose(rate, "Tc-99m")
    print(f"dose of the activity: {float(dose.array[heart].mean()):.2f} mGy in the heart")

    # Motion: the CT is the reference.
    shift, rotation = np.array([3.0, -3.0, 2.6]), np.radians([1.5, 1.5, -2.1])
    pose = affine_matrix(rotations(rotation[None])[0], shift)
    moved = mph.mu_to_hu(torso.voxelize(FINE, pose, quantity="mu"), torso.mu_energy)
    now = line_integrals(moved, 3)
    finder = mph.MotionFinder(found, xray.views())
    for words in ("first", "again"):
        start = time.monotonic()
        motion = finder(now)
        print(f"motion, {words}: {time.monotonic() - start:.2f} s")
    apart = motion.pose @ [*motion.center, 1] - pose @ [*motion.center, 1]
    turned = np.degrees(np.linalg.norm(motion.rotation - rotation))
    print(
        f"motion of {np.linalg.norm(shift):.1f} mm: {np.linalg.norm(apart[:3]):.2f} mm and {turned:.2f} degrees beside"
    )
    print(f"{time.monotonic() - begun:.0f} s in all")
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        mph.write_system(xray, folder / "xray.xlsx")
        volumes = {"ct": mph.mu_to_hu(found, 70.0), "mu": mu_found, "spect": spect["mu of the CT"], "dose": dose}
        for name, volume in volumes.items():
            mph.write_volume(volume, folder / f"{name}.nii.gz")
        picture(folder / "xray-spect.webp", radiographs, mph.resample(ct, COARSE, "mean"), volumes, spect)


def picture(path: Path, radiographs: np.ndarray, ct: mph.Volume, volumes: dict, spect: dict) -> None:
    """Draw a radiograph and slices through the heart: CT numbers, true and reconstructed; SPECT; dose."""
    from PIL import Image, ImageDraw

    from mphdrr.core.runs.display import Display

    at, side = 31, 250
    tiles = [
        ("radiograph of source 1", radiographs[0], "grey", (0, float(radiographs[0].max()))),
        ("CT numbers, truth", ct.array[:, :, at].T[::-1], "grey", (-1000, 500)),
        ("CT numbers, 24 sources", volumes["ct"].array[:, :, at].T[::-1], "grey", (-1000, 500)),
        *((f"SPECT, {name}", v.array[:, :, at].T[::-1], "inferno", (0, 80)) for name, v in spect.items()),
        ("dose of the activity, 0 to 15 mGy", volumes["dose"].array[:, :, at].T[::-1], "inferno", (0, 15)),
    ]
    tall = side * 3 // 4 + 26
    page = Image.new("RGB", (4 * (side + 8) + 8, 2 * tall + 4), (24, 26, 29))
    write = ImageDraw.Draw(page)
    for i, (name, values, colors, window) in enumerate(tiles):
        left, top = 8 + i % 4 * (side + 8), 4 + i // 4 * tall
        drawn = Image.fromarray(Display(colors).colored(np.asarray(values, np.float32), window))
        scale = side / max(drawn.size)
        drawn = drawn.resize((round(drawn.width * scale), round(drawn.height * scale)), Image.Resampling.BILINEAR)
        write.text((left, top), name, fill=(220, 222, 226))
        page.paste(drawn.convert("RGB"), (left, top + 18))
    page.save(path, quality=88)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
