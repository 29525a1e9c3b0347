"""A multi-pinhole SPECT scanner in GATE 10 (opengate 10.1 or later); its numbers are in simulation.json beside this file.

    python simulation.py                  run it: singles_*.root, then images.npy
    python simulation.py --build-only     build it in Geant4, which checks for overlaps; needs no Geant4 data
    python simulation.py --images-only    make images.npy from existing singles

images.npy is (modules, rows, columns): the singles in the energy window, pixel by pixel of each crystal, columns along the
module's u and rows along its v, in the order of the modules in simulation.json.
"""

import argparse
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FOLDER = Path(__file__).resolve().parent


def build(data: dict[str, Any], threads: int = 1) -> Any:
    """Return the simulation described by `data`."""
    import opengate

    units = opengate.g4_units
    simulation = opengate.Simulation()
    simulation.output_dir = FOLDER
    simulation.number_of_threads = threads
    simulation.random_engine = "MersenneTwister"
    simulation.random_seed = data["seed"]
    simulation.run_timing_intervals = [[0, data["time_s"] * units.s]]
    simulation.check_volumes_overlap = True

    simulation.volume_manager.add_material_database(str(FOLDER / "GateMaterials.db"))
    simulation.world.size = [data["world_mm"] * units.mm] * 3
    simulation.world.material = "Air"
    for part in data["volumes"]:
        add_volume(simulation, units, part)

    simulation.physics_manager.physics_list_name = "G4EmStandardPhysics_option4"
    for particle in ("gamma", "electron", "positron"):
        simulation.physics_manager.set_production_cut("world", particle, 0.1 * units.mm)

    share = activity_for_each_thread(opengate, threads)
    for number, emitter in enumerate(data["emitters"]):
        add_source(simulation, units, data, number, emitter, share)
    for crystal in data["crystals"]:
        add_digitizer(simulation, units, data["detector"], crystal)
    simulation.add_actor("SimulationStatisticsActor", "statistics").output_filename = "statistics.txt"
    return simulation


def construct(simulation: Any) -> None:
    """Build the volumes in Geant4, without physics; Geant4 prints the overlaps that it finds."""
    simulation.volume_manager.update_volume_tree_if_needed()
    for volume in simulation.volume_manager.volume_tree_root.descendants:
        volume.construct()


def add_volume(simulation: Any, units: Any, part: dict[str, Any]) -> None:
    """Add a volume at all its places. `rotations` turn the volume, as opengate's do: their columns are its axes."""
    size = [length * units.mm for length in part["size_mm"]]
    a, b, half = size[0], size[1], size[-1] / 2
    turn = {"sphi": 0, "dphi": 360 * units.deg}
    kind, settings = {
        "box": ("Box", {"size": size}),
        "trd": ("Trd", {"dx1": a, "dy1": a, "dx2": b, "dy2": b, "dz": half}),
        "cone": ("Cons", {"rmin1": 0, "rmax1": a, "rmin2": 0, "rmax2": b, "dz": half, **turn}),
        "cylinder": ("Tubs", {"rmin": 0, "rmax": a, "dz": half, **turn}),
    }[part["shape"]]
    volume = simulation.add_volume(kind, part["name"])
    for name, value in settings.items():
        setattr(volume, name, value)
    volume.mother = part["mother"]
    volume.material = part["material"]
    volume.translation = [np.array(center) * units.mm for center in part["centers_mm"]]
    volume.rotation = [np.array(rotation) for rotation in part["rotations"]]


def activity_for_each_thread(opengate: Any, threads: int) -> float:
    """Return the share of the activity to give to a source so that all threads together emit all of it.

    In opengate 10.0 to 10.1.1 every thread emits the whole activity of its source; later ones divide it among the threads.
    The version number does not distinguish them, so a trial source shows what it hands to a thread.
    """
    if threads == 1:
        return 1.0
    trial = opengate.Simulation()
    trial.number_of_threads = threads
    source = trial.add_source("GenericSource", "trial")
    source.particle, source.activity = "gamma", 1.0
    given = {"activity": 1.0}  # before 10.1.1 a thread used the source itself

    class Listener:
        def InitializeUserInfo(self, info: Any) -> None:
            given["activity"] = float(info["activity"])

    if hasattr(source, "initialize_g4_source"):
        source.initialize_g4_source(Listener(), [[0, 1.0]])
    for emitted in (1.0, 1.0 / threads):
        if abs(given["activity"] - emitted) < 1e-9:
            return 1.0 / (threads * emitted)
    found = f"each of {threads} threads would emit {given['activity']:g} of the activity"
    advice = "use --threads 1, and run copies with other seeds"
    raise SystemExit(f"opengate {opengate.__version__}: {found}, expected all or 1/{threads} of it; {advice}")


def add_source(
    simulation: Any, units: Any, data: dict[str, Any], number: int, emitter: dict[str, Any], share: float
) -> None:
    """Add a point, or a rod of the phantom, with `share` of its activity."""
    source = simulation.add_source("GenericSource", f"source_{number}")
    source.attached_to = emitter["mother"]
    source.particle = "gamma"
    energies, photons = np.transpose(data["lines_keV_photons_per_decay"])
    source.energy.type = "spectrum_discrete"
    source.energy.spectrum_energies = (energies * units.keV).tolist()
    source.energy.spectrum_weights = (photons / photons.sum()).tolist()
    source.activity = emitter["activity_Bq"] * photons.sum() * share * units.Bq
    source.half_life = data["half_life_s"] * units.s
    source.direction.type = "iso"
    source.position.translation = [x * units.mm for x in emitter["center_mm"]]
    source.position.type = "cylinder" if "radius_mm" in emitter else "point"
    if "radius_mm" in emitter:
        source.position.radius = emitter["radius_mm"] * units.mm
        source.position.dz = emitter["height_mm"] / 2 * units.mm


def add_digitizer(simulation: Any, units: Any, detector: dict[str, Any], crystal: str) -> None:
    """Add the chain of one kind of crystal: hits, singles, blurred energies and positions, energy window."""
    hits = simulation.add_actor("DigitizerHitsCollectionActor", f"{crystal}_hits")
    hits.attributes = ["TotalEnergyDeposit", "PostPosition", "PreStepUniqueVolumeID", "GlobalTime"]
    chain = [hits]

    def add(kind: str, name: str) -> Any:
        """Add an actor of this kind to the chain, after the one before, and return it."""
        actor = simulation.add_actor(kind, f"{crystal}_{name}")
        actor.input_digi_collection = chain[-1].name
        chain.append(actor)
        return actor

    add("DigitizerAdderActor", "singles").policy = "EnergyWeightedCentroidPosition"
    if detector["energy_resolution"]:
        energy = add("DigitizerBlurringActor", "energy")
        energy.blur_attribute = "TotalEnergyDeposit"
        energy.blur_method = "InverseSquare"
        energy.blur_resolution = detector["energy_resolution"]
        energy.blur_reference_value = detector["reference_keV"] * units.keV
    if detector["intrinsic_fwhm_mm"]:
        place = add("DigitizerSpatialBlurringActor", "place")
        place.blur_attribute = "PostPosition"
        place.blur_fwhm = detector["intrinsic_fwhm_mm"] * units.mm
        place.keep_in_solid_limits = True
        place.use_truncated_Gaussian = False
    window = add("DigitizerEnergyWindowsActor", "window")
    low, high = detector["window_keV"]
    window.channels = [{"name": f"{crystal}_peak", "min": low * units.keV, "max": high * units.keV}]
    for actor in chain:
        actor.attached_to = crystal
        actor.authorize_repeated_volumes = True
        actor.root_output.write_to_disk = actor is window
    window.output_filename = f"singles_{crystal}.root"


def check_emitted(data: dict[str, Any], emitted: int) -> None:
    """Stop with an error unless as many photons were emitted as the activity asks for, within 6 standard deviations."""
    decay = np.log(2) / data["half_life_s"]
    photons = sum(photons for _, photons in data["lines_keV_photons_per_decay"])
    decays = sum(emitter["activity_Bq"] for emitter in data["emitters"]) * -np.expm1(-decay * data["time_s"]) / decay
    if abs(emitted - photons * decays) > 6 * np.sqrt(photons * decays) + 1:
        found = f"{emitted} photons were emitted, expected {photons * decays:.0f}"
        raise SystemExit(f"{found}: do not use images.npy; use --threads 1")


def images(data: dict[str, Any], positions: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Return images (modules, rows, columns) of singles at world `positions` (N, 3), mm, in any crystal."""
    rows, columns = data["image_shape"]
    made = np.zeros((len(data["modules"]), rows, columns), np.uint32)
    for image, module in zip(made, data["modules"], strict=True):
        local = (positions - module["crystal_center_mm"]) @ np.transpose(module["axes_uvk"])
        half = np.array(module["crystal_size_mm"]) / 2
        local = local[np.all(np.abs(local) <= half + 1e-3, axis=1)]
        pixels = np.floor((local[:, :2] / half[:2] + 1) / 2 * (columns, rows))
        column, row = np.clip(pixels, 0, (columns - 1, rows - 1)).astype(int).T
        np.add.at(image, (row, column), 1)
    return made


def read_positions(data: dict[str, Any]) -> NDArray[np.float64]:
    """Return the world positions (N, 3), mm, of all singles in the energy window."""
    import uproot

    found = [np.zeros((0, 3))]
    for crystal in data["crystals"]:
        with uproot.open(FOLDER / f"singles_{crystal}.root") as file:
            tree = file[f"{crystal}_peak"]
            found.append(np.stack([tree[f"PostPosition_{axis}"].array(library="np") for axis in "XYZ"], axis=1))
    return np.concatenate(found)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--build-only", action="store_true", help="build the volumes, check for overlaps and stop")
    parser.add_argument("--images-only", action="store_true", help="make images from existing singles")
    parser.add_argument("--threads", type=int, help="instead of the number in simulation.json")
    arguments = parser.parse_args()
    data = json.loads((FOLDER / "simulation.json").read_text())
    if arguments.build_only:
        os.environ.setdefault("GATEONRTD", "1")  # opengate then does not look for Geant4's data when it is imported
    if not arguments.images_only:
        simulation = build(data, arguments.threads or data["threads"])
        if arguments.build_only:
            construct(simulation)
            return
        simulation.run()
    np.save(FOLDER / "images.npy", images(data, read_positions(data)))
    if not arguments.images_only:
        check_emitted(data, int(simulation.get_actor("statistics").counts.events))


if __name__ == "__main__":
    main()
