"""A disk that is full: one line, nothing left, and the old file as it was, whatever is written."""

import contextlib
import gc
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.figures.page import Page
from mphdrr.core.runs.mosaic import write_png

from .conftest import needs_torch, refused

# What openpyxl leaves open complains when it is collected.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

SIZE = 64 << 10
"""Of the disk; every file below is larger."""


@pytest.fixture(autouse=True)
def collected() -> Iterator[None]:
    """Collect garbage here, not in another test; libraries' files that are still open keep their room on the disk."""
    yield
    gc.collect()
    gc.freeze()  # what is left is not looked at again


def modules(count: int = 300) -> mph.PinholeSystem:
    """Return a scanner of many modules: what describes them is larger than the disk."""
    angles = np.linspace(0, 6.2, count)
    centers = np.stack([200 * np.cos(angles), 200 * np.sin(angles), np.linspace(-50, 50, count)], axis=1)
    return mph.PinholeSystem(centers, 2.0, 60.0, detector_side=40, detector_thickness=8, roi_radius=50)


MODULES, RNG = modules(), np.random.default_rng(3)
VOLUME = mph.Volume(RNG.random((32, 32, 32), np.float32), mph.Grid((32, 32, 32), np.eye(4)), "activity")
IMAGES, VIEWS = np.ones((len(MODULES), 4, 6), np.float32), MODULES.views((4, 6), "real", pitch=(7, 7))
RUN = mph.ProjectionRun(IMAGES, MODULES, VIEWS, VOLUME)
RECONSTRUCTION = mph.Reconstruction(VOLUME, np.ones(3), {"method": "mlem"}, {"previous": VOLUME.array})
MESH = mph.Mesh(RNG.random((9000, 3)), np.arange(9000).reshape(-1, 3))
PHANTOM = mph.ShapePhantom(tuple(mph.Sphere(radius=k + 1.0, activity=1.0) for k in range(2000)))
PAGE = Page(400, 300)
PAGE.image(RNG.integers(0, 255, (150, 150, 3), np.uint8), 0, 0, 400, 300)


WRITERS: dict[str, Callable[[Path], object]] = {
    **{f"run{ending}": lambda path: mph.write_run(RUN, path) for ending in (".h5", ".npz", ".pt")},
    **{
        f"volume{ending}": lambda path: mph.write_volume(VOLUME, path)
        for ending in (".h5", ".npz", ".nrrd", ".nii", ".nii.gz")
    },
    "reconstruction.h5": lambda path: mph.write_reconstruction(RECONSTRUCTION, path),
    **{
        name: lambda path, format=format, count=count: mph.write_geometry(modules(count), path, format)
        for name, format, count in (
            ("geometry.json", "mphdrr", 300), ("cameras.json", "opencv", 300), ("geometry.xml", "rtk", 300),
            ("geometry.transforms.json", "nerf", 300), ("solids.stl", "stl", 120), ("solids.3mf", "3mf", 120),
            ("solids.glb", "glb", 120), ("cameras.npz", "opencv", 1000), ("parts", "stl-parts", 300),
            ("gate9", "gate9", 300), ("gate10", "gate10", 300))
    },
    **{f"mesh{ending}": lambda path: mph.write_mesh(MESH, path) for ending in (".stl", ".obj", ".ply", ".glb")},
    **{f"page{ending}": lambda path: PAGE.write(path) for ending in (".png", ".svg")},
    "mosaic.png": lambda path: write_png(np.random.default_rng(3).random((300, 300)), path),
    "columns.toml": lambda path: mph.ColumnMap(()).write(path, "word\n" * SIZE),
    "phantom.toml": lambda path: mph.write_phantom(PHANTOM, path),
    "scanner.xlsx": lambda path: mph.write_system(MODULES, path),
}  # fmt: skip
"""The writers, by the name of the file or, without an ending, the folder."""
NAMES = [pytest.param(name, marks=needs_torch) if name == "run.pt" else name for name in WRITERS]


def refused_and_nothing_left(write: Callable[[Path], object], path: Path) -> None:
    """Check a refusal that leaves nothing, where there is no file yet, and where there is one."""
    refused(lambda: write(path), str(path), "cannot be written")
    assert list(path.parent.iterdir()) == []
    if path.suffix:
        gc.collect()  # closes files of libraries, which keep the room of removed ones
        path.write_bytes(b"old")
        refused(lambda: write(path), str(path), "cannot be written")
        assert path.read_bytes() == b"old" and list(path.parent.iterdir()) == [path]


@pytest.fixture(scope="module")
def full_disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield a folder on a disk of `SIZE` bytes."""
    folder = tmp_path_factory.mktemp("disk")
    command = ["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "none", str(folder)]
    with contextlib.suppress(OSError):
        if subprocess.run(command, capture_output=True).returncode == 0:
            yield folder
            subprocess.run(["umount", str(folder)], check=True)
            return
    pytest.skip("no small disk can be mounted here")


@pytest.fixture
def disk(full_disk: Path) -> Iterator[Path]:
    yield full_disk
    for left in full_disk.iterdir():
        left.unlink()


@pytest.mark.parametrize("name", NAMES)
def test_a_full_disk_is_one_line_and_leaves_what_was_there(disk, name):
    refused_and_nothing_left(WRITERS[name], disk / name)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("most", [0, 700, 20000])
def test_a_write_that_fails_at_any_byte_is_one_line(tmp_path, name, most):
    resource = pytest.importorskip("resource", reason="no limits of files' sizes here")
    import signal

    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        if name in ("parts", "gate10", "gate9") and most > 1000:
            pytest.skip("each of its files is smaller")
        write = WRITERS[name]
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
        path = tmp_path / name
        refused(lambda: write(path), str(path), "cannot be written")
        assert list(path.parent.iterdir()) == []
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_a_disk_that_fails_when_it_is_flushed_is_one_line(tmp_path, monkeypatch):
    """As those of other machines do, which take every byte at first."""

    def fail(descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", fail)
    for name in ("run.h5", "volume.nii.gz", "page.png"):
        refused_and_nothing_left(WRITERS[name], tmp_path / name)
        (tmp_path / name).unlink()


def test_a_device_is_not_replaced(tmp_path):
    """Root could: /dev/full, or what a link with the right ending leads to."""
    device = tmp_path / "run.h5"
    try:
        device.symlink_to("/dev/full")
    except OSError as error:
        pytest.skip(f"no links here ({error})")
    if not Path("/dev/full").exists():
        pytest.skip("no devices here")
    refused(lambda: mph.write_run(RUN, device), str(device), "is no file")
    assert Path("/dev/full").is_char_device()


def test_the_file_of_a_killed_process_of_the_same_number_does_not_stop_the_next(tmp_path, monkeypatch):
    """In containers, every process has the number 1."""
    monkeypatch.setattr(os, "getpid", lambda: 1)
    code = "import os; os.getpid = lambda: 1\nfrom mphdrr.core.files import replacing\n"
    code += f"with replacing({str(tmp_path / 'a')!r}) as temporary:\n temporary.touch()\n os._exit(0)"
    subprocess.run([sys.executable, "-c", code], check=True)
    assert len(list(tmp_path.iterdir())) == 1
    mph.write_volume(VOLUME, tmp_path / "a.h5")


COMMANDS = {
    "project": ["project", "{workbook}", "--volume", "{volume}", "--modules", "1-4", "--size", "64", "64", "-o", "{out}.h5"],
    "volume convert": ["volume", "convert", "{volume}", "-o", "{out}.nrrd"],
    "export": ["export", "{run}", "-o", "{out}.npz"],
    "phantom": ["phantom", "sphere", "--radius", "9", "--voxels", "40", "-o", "{out}.nii"],
}  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_on_a_full_disk_is_one_line_and_status_1(disk, tmp_path, workbook, capsys, command):
    mph.write_volume(VOLUME, tmp_path / "volume.h5")
    mph.write_run(RUN, tmp_path / "run.h5")
    places = {"workbook": workbook, "volume": tmp_path / "volume.h5", "run": tmp_path / "run.h5", "out": disk / "out"}
    status = main([word.format_map(places) for word in COMMANDS[command]])
    lines = [line for line in capsys.readouterr().err.splitlines() if "warning" not in line and "[#" not in line]
    assert status == 1 and len(lines) == 1 and "No space left on device" in lines[0], lines
    assert list(disk.iterdir()) == []
