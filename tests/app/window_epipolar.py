"""A point source in the example: its pixel clicked on in the mosaic, the marker dragged to it, a pixel picked on a plane."""

import bpy
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d, region_2d_to_origin_3d, region_2d_to_vector_3d
from driving import WORKBOOK, drawn, editor, idle, open_tab, opened, ours, press, run, seen
from pauses import own_time
from pointing import on_screen, picture, xdotool

core, epipolar, epipolar_drawing = map(
    ours, ("core", "addon.perspective.epipolar", "addon.perspective.epipolar_drawing")
)
images, planes, tiles = (ours(f"addon.pictures.{name}") for name in ("images", "planes", "tiles"))
bpy.context.preferences.inputs.use_mouse_continuous = False  # or the mouse is put elsewhere while a slider is dragged
NUMBER, PIXEL, SHARE = 30, (37, 26), 0.94  # the module, its pixel, and the point's depth in it over the isocentre's
BLUE = np.array([0x47, 0x72, 0xB3])  # of Blender's sliders


def place_of(number: int, pixel: tuple[float, float]) -> tuple[int, int]:
    """Return the position on the screen of a pixel of a module's tile."""
    _, area, region = editor("IMAGE_EDITOR")
    image = area.spaces.active.image
    (tile,) = (each for each in tiles.shown_pictures(image) if each.number == number)
    row, column = tile.image_positions(pixel, epipolar.run_views(bpy.context.scene).views.shape)
    return on_screen(*region.view2d.view_to_region(column / image.size[0], 1 - row / image.size[1]), "IMAGE_EDITOR")


def slider() -> tuple[int, int]:
    """Return a place in the filled part of the slider in the Image Editor's sidebar, the widest blue there."""
    window, area, _ = editor("IMAGE_EDITOR")
    sidebar = next(region for region in area.regions if region.type == "UI")
    shot = bpy.data.images.load(str(picture("slider")))
    width, height = shot.size
    screen = np.rint(np.array(shot.pixels).reshape(height, width, 4)[..., :3] * 255).astype(int)
    bpy.data.images.remove(shot)
    part = screen[sidebar.y : sidebar.y + sidebar.height, sidebar.x : sidebar.x + sidebar.width]
    blue = (np.abs(part - BLUE) < 12).all(axis=2)
    widths = blue.sum(axis=1)
    row = int(np.median(np.flatnonzero(widths == widths.max())))
    columns = np.flatnonzero(blue[row])
    seen["blue"] = [int(blue[row].sum()), row, sidebar.width]
    return sidebar.x + int(columns[len(columns) // 4]), window.height - 1 - sidebar.y - row


def pixel() -> list[float]:
    """Return the picked pixel after the number of its module."""
    found = epipolar.picked_pixel(bpy.context.scene)
    return [found.run.numbers[found.index], *found.pixel.tolist()]


def steps():
    """Yield seconds to wait."""
    opened("MPHDRR_PT_epipolar_of_images", but_closed=("MPHDRR_PT_display_of_images", "MPHDRR_PT_runs_of_images"))
    press(bpy.ops.mphdrr.load_example)
    yield from idle()
    yield from drawn()
    scene = bpy.context.scene
    bpy.data.objects["Derenzo"].hide_viewport = True
    # The point is where the pixel's ray is, at a depth of its own.
    system = core.read_system(WORKBOOK)
    views = system.views((64, 64))
    b = np.linalg.norm(system.centers[NUMBER - 1])
    point = core.points_at_depths(views, NUMBER - 1, PIXEL, SHARE * b)
    seen["point"] = point.tolist()
    press(bpy.ops.mphdrr.add_points, "EXEC_DEFAULT", counts=(1, 1, 1), diameter=6.0, voxels=24, location=point.tolist())
    yield from idle()
    settings = scene.mphdrr_projections
    settings.volume = bpy.context.object
    settings.width = settings.height = 64
    press(bpy.ops.mphdrr.render_projections)
    yield from idle()
    yield from drawn()
    _, area, region = editor("IMAGE_EDITOR")
    area.spaces.active.show_region_ui = True
    yield from drawn()
    open_tab("IMAGE_EDITOR")
    yield from drawn()
    # A pixel is several of the screen's then.
    press(bpy.ops.image.view_zoom_ratio, "EXEC_DEFAULT", kind="IMAGE_EDITOR", ratio=2.0)
    yield from drawn()
    start = np.array(place_of(NUMBER, PIXEL))
    middle = np.array(on_screen(region.width / 2, region.height / 2, "IMAGE_EDITOR"))
    offset = (np.array([1, -1]) * (start - middle) / 2).tolist()
    press(bpy.ops.image.view_pan, "EXEC_DEFAULT", kind="IMAGE_EDITOR", offset=offset)
    yield from drawn()
    press(bpy.ops.mphdrr.pick_pixel, kind="IMAGE_EDITOR")
    yield 0.5
    at = place_of(NUMBER, PIXEL)
    seen["clicked at"] = at
    xdotool("mousemove", *at)
    yield 0.5
    xdotool("click", 1)
    yield lambda: epipolar.picked_pixel(scene) is not None
    yield from drawn()
    found = epipolar.picked_pixel(scene)
    seen["picked"] = None if found is None else [*pixel(), found.seen_by]
    picture("picked")
    press(bpy.ops.image.view_all, "EXEC_DEFAULT", kind="IMAGE_EDITOR", fit_view=True)
    yield from drawn()
    before = found.marker_pixels
    x, y = slider()
    wanted = found.k / SHARE
    front, back = found.k_range
    xdotool("mousemove", x, y)
    yield 0.5
    xdotool("mousedown", 1)
    yield 0.3
    trail = []
    direction = 1 if (wanted - scene.mphdrr_epipolar.k) / (back - front) > 0 else -1
    for _ in range(120):
        left = (wanted - scene.mphdrr_epipolar.k) / (back - front) * direction
        trail.append(scene.mphdrr_epipolar.k)
        if left < 0.004:
            break
        x += direction * (4 if left > 0.05 else 1)
        xdotool("mousemove", x, y)
        yield 0.25
    xdotool("mouseup", 1)
    yield from drawn()
    found = epipolar.picked_pixel(scene)
    seen["k"] = [wanted, found.k, len(set(trail))]
    seen["marker"] = found.marker.tolist()
    seen["moved"] = float(np.nanmedian(np.linalg.norm(found.marker_pixels - before, axis=1)))
    off = []
    for number, place in zip(found.run.numbers, found.marker_pixels, strict=True):
        exact = images.projection_array(bpy.data.images[f"mphDRR {number}" if number > 9 else f"mphDRR 0{number}"])
        exact = exact.astype(float)
        rows, columns = np.indices(exact.shape)
        weight = exact.sum()
        if not np.isfinite(place).all():
            off.append(None if weight == 0 else float(weight))
            continue
        centre = np.array([(exact * columns).sum(), (exact * rows).sum()]) / weight
        off.append(float(np.abs(centre - place).max()))
    seen["off"], seen["seen by"] = off, found.seen_by
    started = own_time()
    for k in np.linspace(front, back, 50):
        scene.mphdrr_epipolar.k = k
        epipolar.picked_pixel(scene)
    seen["ms for each k"] = 20 * (own_time() - started)
    scene.mphdrr_epipolar.k = found.k
    yield from drawn()
    spent = []
    for draw in (epipolar_drawing.draw_over_pictures, epipolar_drawing.draw_in_scene):
        kind = "IMAGE_EDITOR" if draw is epipolar_drawing.draw_over_pictures else "VIEW_3D"
        window, area, region = editor(kind)
        with bpy.context.temp_override(window=window, area=area, region=region):
            times = []
            for _ in range(5):
                started = own_time()
                draw()
                times.append(1e3 * (own_time() - started))
            spent.append(float(np.median(times)))
    seen["ms to draw"] = spent
    picture("marker")
    # A pixel of a plane in the scene, of one that is seen.
    _, area, region = editor("VIEW_3D")
    space = area.spaces.active.region_3d
    target = None
    for plane in planes.planes(scene):
        flat = location_3d_to_region_2d(region, space, plane.matrix_world.translation)
        if flat is None or not (100 < flat[0] < region.width - 400 and 100 < flat[1] < region.height - 100):
            continue
        at = round(flat[0]), round(flat[1])  # as the mouse
        way = np.array(region_2d_to_vector_3d(region, space, at))
        if way @ np.array(plane.matrix_world)[:3, 2] > 0.5:  # it faces the view
            with bpy.context.temp_override(area=area, region=region):
                hit = epipolar_drawing.plane_pixel(
                    bpy.context, found.run, np.array(region_2d_to_origin_3d(region, space, at)), way
                )
            if hit is not None and hit[0] == plane.mphdrr_module.number:
                target = hit, on_screen(*at)
                break
    seen["target"] = target
    press(bpy.ops.mphdrr.pick_pixel)
    yield 0.5
    xdotool("mousemove", *target[1])
    yield 0.5
    xdotool("click", 1)
    before = pixel()
    yield lambda: pixel() != before
    yield from drawn()
    seen["on plane"] = pixel()
    picture("plane")


run(steps())
