"""Draw every phantom, a CT, the scanner's sensitivity, back-projections, events and the demo.

    python examples/gallery.py FOLDER [CT]

`make gallery` writes the pictures to docs/images. CT is a volume file of CT numbers; without it, its pictures are omitted.
The pictures in the scanner need Blender's Python module (bpy).
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import mphdrr.core as mph
from mphdrr.core.events.contact_sheet import contact_sheet
from mphdrr.core.events.templates import template_text
from mphdrr.core.example import EULER_DEGREES
from mphdrr.core.runs.display import Display

HERE = Path(__file__).parent
TILE, MARGIN, TEXT = 180, 8, 22
LARGEST = 1800  # pixels
MODULE = 30  # whose projection is shown
PHANTOMS = {
    "Derenzo": mph.DerenzoPhantom(40, (8, 6, 5, 4, 3, 2), 40, 100),
    "NEMA body": mph.NemaBody(),
    "Jaszczak": mph.JaszczakPhantom(),
    "Defrise": mph.DefrisePhantom(),
    "Shepp-Logan": mph.SheppLogan(),
    "points": mph.PointGrid(),
    "cardiac torso": mph.CardiacTorso(),
    **{path.stem.replace("_", " "): mph.read_phantom(path) for path in sorted((HERE / "phantoms").glob("*.toml"))},
}
# The point through which the slices go, mm, where `telling` would miss the interesting ones.
THROUGH = {"Jaszczak": (0.0, 40.0, -50.0), "cardiac torso": (0.0, 0.0, 0.0)}


def main(folder: Path, ct: Path | None) -> None:
    """Write all pictures into a folder."""
    system = mph.read_system(HERE / "dc-spect-80.xlsx")
    volumes = {name: phantom.voxelize(grid_of(phantom)) for name, phantom in PHANTOMS.items()}
    hounsfield = None
    if ct is not None:
        hounsfield = mph.centered(mph.read_volume(ct))
        volumes["chest CT"] = mph.hu_to_mu(hounsfield)
    keep(sheet(system, volumes), folder / "gallery.webp")
    keep(back_projections(system), folder / "back-projections.webp")
    keep(events(), folder / "event-sets.webp")
    in_the_scanner(system, folder, hounsfield)


def keep(picture: Image.Image, path: Path) -> None:
    """Write a picture as a small file, not larger than a page shows it."""
    picture = picture.convert("RGB")
    picture.thumbnail((LARGEST, LARGEST), Image.Resampling.LANCZOS)
    picture.save(path, quality=88, method=6)
    print(path)


def grid_of(phantom: mph.Phantom) -> mph.Grid:
    """Return a grid that contains a phantom."""
    voxels = 160
    return mph.Grid.centered(voxels, phantom.extent / (voxels - 2))


def sheet(system: mph.PinholeSystem, volumes: dict[str, mph.Volume]) -> Image.Image:
    """Draw two columns of volumes: slices across z, y and x of each, and its projection."""
    views = system[system.numbers == MODULE].views((TILE, TILE))
    width, height, rows = 4 * (TILE + MARGIN) + MARGIN, TILE + TEXT + MARGIN, -(-len(volumes) // 2)
    page = Image.new("RGB", (2 * width, rows * height + MARGIN), (24, 26, 29))
    write = ImageDraw.Draw(page)
    for place, (name, volume) in enumerate(volumes.items()):
        array = volume.array
        at = telling(array)
        if name in THROUGH:
            at = np.rint(volume.grid.index_from_world[:3] @ (*THROUGH[name], 1.0)).astype(int).tolist()
        # Seen from above, from the front and from the left; the picture's first row is the top.
        slices = [s.T for s in (array[:, :, at[2]], array[:, at[1], :], array[at[0], :, :])]
        middle, side = framed(array)
        slices = [around(s, middle[axes], side) for s, axes in zip(slices, ([1, 0], [2, 0], [2, 1]), strict=True)]
        (image,) = mph.as_seen(mph.Projector(volume.grid, views)(volume))
        left, top = place // rows * width + MARGIN, place % rows * height + MARGIN
        title = f"{name}: slices, {volume.unit}; projection of module {MODULE}"
        write.text((left, top + 4), title, fill=(220, 222, 226))
        for column, picture in enumerate([*(s[::-1] for s in slices), image]):
            tile = colored(picture, volume.quantity != "activity").resize((TILE, TILE), Image.Resampling.BILINEAR)
            page.paste(tile, (left + column * (TILE + MARGIN), top + TEXT))
    return page


def back_projections(system: mph.PinholeSystem) -> Image.Image:
    """Draw truth, sum, product and minimum, each from 0 to its largest: a row for ideal holes, one for the scanner's."""
    views, size = system.views((128, 128)), 2 * TILE - MARGIN
    grid = mph.Grid.centered((84, 84, 42), 1.0)
    truth = PHANTOMS["Derenzo"].voxelize(mph.Grid.centered((168, 168, 84), 0.5))
    page = Image.new("RGB", (4 * (size + MARGIN) + MARGIN, 2 * (size + TEXT + MARGIN) + MARGIN), (24, 26, 29))
    write = ImageDraw.Draw(page)
    ideal, real = mph.Emission(system, hole="point", pixel_points=1, tolerance=1e9), mph.Emission(system)
    for row, (name, model) in enumerate({"ideal holes": ideal, "the scanner's holes": real}.items()):
        counts = mph.Projector(truth.grid, views, model)(truth)
        settings = {"recipe": {"model": {"kind": "emission"}}}
        run = mph.ProjectionRun(counts, system, views, unit="counts", settings=settings)
        said = {how: mph.backproject_run(run, how, grid=grid) for how in ("sum", "product", "minimum")}
        for column, (label, volume) in enumerate({"truth": truth, **said}.items()):
            middle = volume.grid.shape[2] // 2
            picture = colored(volume.array[:, :, middle].T[::-1], grey=False)
            left, top = column * (size + MARGIN) + MARGIN, row * (size + TEXT + MARGIN) + MARGIN
            write.text((left, top + 4), f"{label}; {name}" if column else label, fill=(220, 222, 226))
            page.paste(picture.resize((size, size), Image.Resampling.BICUBIC), (left, top + TEXT))
    return page


def events() -> Image.Image:
    """Draw three events of the recipe that `mphdrr events new --like derenzo` writes, in voxels of half the size."""
    recipe = mph.events.EventRecipe(template_text("derenzo").replace("spacing = 1.0", "spacing = 0.5"))
    with tempfile.TemporaryDirectory() as folder:
        made = mph.events.make(recipe, Path(folder, "derenzo"), 3)
        title = "An event set: phantoms turned at random, and what 80 pinholes see of them"
        return Image.fromarray(contact_sheet(list(made), "emission", title).picture)


def telling(array: np.ndarray) -> list[int]:
    """Return, along each axis, the index of the slice near the middle with the most contrast."""
    places = []
    for axis in range(3):
        n = array.shape[axis]
        near = range(n // 2 - n // 8, n // 2 + n // 8 + 1)
        places.append(max(near, key=lambda i: (float(array.take(i, axis).std()), -abs(i - n // 2))))
    return places


def framed(array: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the index at the middle of the filled voxels, and the side of a cube around it that contains them."""
    filled = np.argwhere(array > 0.02 * array.max())
    low, high = filled.min(axis=0), filled.max(axis=0)
    return (low + high) // 2, int((high - low).max()) + 8


def around(picture: np.ndarray, middle: np.ndarray, side: int) -> np.ndarray:
    """Return the square of a picture around a pixel, 0 outside the picture."""
    first = middle + side - side // 2  # of the padded picture
    return np.pad(picture, side)[first[0] : first[0] + side, first[1] : first[1] + side]


def colored(picture: np.ndarray, grey: bool) -> Image.Image:
    """Color values from 0 to nearly the largest."""
    window = 0.0, max(float(np.quantile(picture, 0.999)), 1e-12)
    return Image.fromarray(Display("grey" if grey else "inferno").colored(picture, window))


def in_the_scanner(system: mph.PinholeSystem, folder: Path, ct: mph.Volume | None) -> None:
    """Draw a phantom, the sensitivity map, and the CT, between the modules; and the demo's pictures."""
    try:
        import bpy
    except ImportError:
        print("no bpy: the pictures in the scanner are omitted", file=sys.stderr)
        return
    from mphdrr.addon import cli
    from mphdrr.addon.blender import jobs
    from mphdrr.addon.cli.scene import new_scene, quiet
    from mphdrr.addon.figures import figures
    from mphdrr.addon.scanner import maps, scanner
    from mphdrr.addon.volumes import slices, volumes

    with tempfile.TemporaryDirectory() as demo:
        cli.main(["demo", "--output", demo])
        for name in ("mosaic", "phantom", "cut-away"):
            keep(Image.open(Path(demo, f"{name}.png")), folder / f"{name}.webp")

    scene = new_scene()
    scanner.build_scanner(scene, system)

    def picture(name: str, kind: str = "inside", size: tuple[int, int] = (960, 560)) -> None:
        with tempfile.TemporaryDirectory() as made, quiet():
            path = Path(made, "picture.png")
            jobs.run(figures.figure_job(bpy.context, kind, [path], size, samples=12))
            drawn = Image.open(path).convert("RGB")
        keep(drawn, folder / f"{name}.webp")

    pose = mph.euler_pose(*np.deg2rad(EULER_DEGREES), (0.0, 0.0, 0.0))
    volumes.add_volume(PHANTOMS["Derenzo"].voxelize(mph.Grid.centered(256, 0.4), pose), "Derenzo phantom")
    picture("picture", "picture", (1200, 750))
    bpy.data.objects.remove(*volumes.volume_objects(scene))
    jobs.run(maps.map_job(scene, "sensitivity", voxels=128))
    slices.remove_slices(*volumes.volume_objects(scene))  # it is cut open in front of them
    picture("sensitivity")
    if ct is not None:
        bpy.data.objects.remove(*volumes.volume_objects(scene))
        volumes.add_volume(ct, "chest CT").mphdrr_volume.look = "BONE"
        picture("ct")


if __name__ == "__main__":
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    main(out, Path(sys.argv[2]) if len(sys.argv) > 2 else None)
