"""All figures of docs/learning-study.md: python run_study.py FOLDER [JOBS].

Event sets, trainings and judgements are made by `mphdrr` from the recipes beside this file, which are copied into FOLDER, by
JOBS processes at once (2). What was interrupted goes on at the next call, and what is there is not made again.
"""

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import study_figures

import mphdrr.core as mph
from mphdrr.core.example import EXAMPLE
from mphdrr.core.learning.judging.sets import set_text

HERE = Path(__file__).parent
SEEDS = (0, 1, 2)
BEGUN = 'weights_from = "after-osem-half-0.pt"'
EVENTS = {
    "train": 990, "derenzo": 50, "unseen": 50, "pairs": 220,
    "sixteen": 50, "moved": 50, "holes": 50, "misaligned": 50, "physics": 50,
}  # fmt: skip
"""How many of each set."""
SIXTEEN = "1,5,9,13,21,25,29,33,41,45,49,53,61,65,69,73"
"""Every fifth of the 20 modules is left out."""
TRAININGS = {
    "after-osem": ("after-osem", 3000, ""),
    "after-osem-half": ("after-osem", 1500, ""),  # others begin with it
    "after-osem-short": ("after-osem", 570, ""),  # about as many steps as the others have
    "unrolled": ("unrolled", 600, "save_memory = false"),
    "unrolled-permuted": ("unrolled", 600, "save_memory = false\npermuted = 1"),  # each module is told another's pose
    "channels": ("channels", 4800, ""),
    "cameras-begun": ("cameras", 270, f"{BEGUN}"),
    "unrolled-begun": ("unrolled", 300, f"save_memory = false\n{BEGUN}"),
    "unrolled-through": ("unrolled", 300, f"save_memory = false\nthrough = true\n{BEGUN}"),
    "hour": ("after-osem", 7000, ""),
    "first": ("after-osem", 1, ""),  # makes the samples that the others share
}
"""Network, steps and settings of each: 180 s of one thread, but for the short one and the last two."""
ONCE = ("hour", "unrolled-through")
"""Those of one seed."""
JUDGES = ("judge-known", "judge-scanners", "judge-pairs")


def scanners(folder: Path) -> None:
    """Write workbooks of unseen scanners: modules moved by 10 mm, wider holes, small misalignments."""
    if (folder / "misaligned.xlsx").exists():  # the last one
        return
    shutil.copy(EXAMPLE, folder / "scanner.xlsx")
    system = mph.read_system(folder / "scanner.xlsx")
    places, axes = np.random.default_rng(1).normal(size=(2, len(system), 3))
    places, axes = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (places, axes))
    for name, scanner in {
        "moved": system.replace(centers=system.centers + 10 * places),
        "holes": system.replace(pinhole_diameter=1.4 * system.pinhole_diameter),
        "misaligned": system.replace(centers=system.centers + 1 * places, tilt=np.radians(0.5) * axes),
    }.items():
        mph.write_system(scanner, folder / f"{name}.xlsx")


def set_recipe(name: str) -> str:
    """Return the recipe of a set: one of the package's, or the Derenzo test's with another scanner or other physics."""
    if name in ("moved", "holes", "misaligned"):
        return set_text("derenzo", f"{name}.xlsx")
    text = set_text(name if name in ("train", "unseen", "pairs") else "derenzo", "scanner.xlsx")
    if name == "sixteen":
        return "\n".join(f'modules = "{SIXTEEN}"' if line.startswith("modules") else line for line in text.split("\n"))
    return text + (HERE / "physics.toml").read_text(encoding="utf-8") if name == "physics" else text


def training_recipe(name: str) -> str:
    """Return the recipe of a training and a seed, such as cameras-1."""
    training, _, seed = name.rpartition("-")
    kind, steps, settings = TRAININGS[training]
    text = (HERE / "training.toml").read_text(encoding="utf-8")
    text = text.replace('kind = "after-osem"', f'kind = "{kind}"\n{settings}').replace(
        "steps = 3000", f"steps = {steps}"
    )
    return text.replace("seed = 0", f"seed = {seed}").replace("-half-0.pt", f"-half-{seed}.pt")


def trainings(have_begun: bool) -> list[str]:
    """Return the names of trainings with seeds, either those that begin with another's weights or the others."""
    return [
        f"{name}-{seed}"
        for seed in SEEDS
        for name, (*_, settings) in TRAININGS.items()
        if name != "first" and (BEGUN in settings) == have_begun and (seed == 0 or name not in ONCE)
    ]


class Study:
    """The work in one folder."""

    def __init__(self, folder: Path, jobs: int) -> None:
        self.folder, self.jobs = folder, jobs

    def run(self, *words: str) -> None:
        """Run one command of mphdrr; its output goes to a file named after it."""
        with open(self.folder / f"{Path(words[-1]).stem}.log", "w", encoding="utf-8") as log:
            command = [sys.executable, "-m", "mphdrr", *words, "--quiet"]
            subprocess.run(command, cwd=self.folder, stdout=log, stderr=subprocess.STDOUT, check=True)
        print(*words, flush=True)

    def write(self, name: str, text: str) -> None:
        """Write a recipe unless it exists."""
        if not (self.folder / name).exists():
            (self.folder / name).write_text(text, encoding="utf-8")

    def events(self, name: str) -> None:
        """Make a set's events."""
        self.write(f"{name}.toml", set_recipe(name))
        self.run("events", "make", "--recipe", f"{name}.toml", "-n", str(EVENTS[name]), f"sets/{name}")

    def train(self, name: str) -> None:
        """Train a network."""
        if not (self.folder / f"{name}.pt").exists():
            self.write(f"{name}.toml", training_recipe(name))
            self.run("learn", "train", f"{name}.toml", "-o", f"{name}.pt")

    def judge(self, name: str) -> None:
        """Judge networks."""
        self.write(f"{name}.toml", (HERE / f"{name}.toml").read_text(encoding="utf-8"))
        self.run("learn", "judge", f"{name}.toml", "-o", name)

    def all(self) -> None:
        """Run all steps in an order in which each has its inputs."""
        self.folder.mkdir(parents=True, exist_ok=True)
        scanners(self.folder)
        self.at_once(self.events, EVENTS)
        self.train("first-0")  # makes the samples that the others share
        for have_begun in (False, True):
            self.at_once(self.train, trainings(have_begun))
        self.at_once(self.judge, JUDGES)
        study_figures.main(self.folder)

    def at_once(self, work: Callable[[str], None], names: Iterable[str]) -> None:
        """Run works, `jobs` at a time; the first error ends all."""
        with ThreadPoolExecutor(self.jobs) as pool:
            list(pool.map(work, names))


if __name__ == "__main__":
    Study(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 2).all()
