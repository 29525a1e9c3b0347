"""One description of the collimator: rays through the drawn, exported and simulated bodies, by ray casters of our own.

Rays go from a point in front of a module to a point of its crystal's front face, and are intersected with triangles read
back from files, or with the convex solids of a GATE macro or script, minus the air in them.
"""

from __future__ import annotations

import json
import math
from itertools import pairwise

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.geometry.checks.plates import needed_angle
from mphdrr.core.geometry.collimator import Collimator, Construction
from mphdrr.core.physics.aperture import KnifeEdge

from .test_monte_carlo import Macros

PLACES = ("middle", "front", "back")
N = 160


class Rays:
    """Rays (3, N) that end on a module's crystal, in its frame (u, v, depth behind the pinhole).

    `crossing`: their points in the pinhole's plane.
    """

    def __init__(self, source: np.ndarray, target: np.ndarray) -> None:
        self.source, self.target = source, target
        self.crossing = source + (target - source) * (source[2] / (source[2] - target[2]))

    def __getitem__(self, chosen: np.ndarray) -> Rays:
        return Rays(self.source[:, chosen], self.target[:, chosen])

    @property
    def on_crystal(self) -> np.ndarray:
        return np.abs(self.target[:2]).max(axis=0)


def from_roi(rng, system, m: int, crossing: np.ndarray) -> Rays:
    """Return rays through `crossing` from the ROI, most from its surface and many from the rim that the pinhole sees."""
    b, radius, l = system.pinhole_distance[m], system.roi_radius[m], system.collimator_length[m]
    n = crossing.shape[1]
    direction = rng.normal(size=(3, n))
    points = radius * direction / np.linalg.norm(direction, axis=0) * rng.choice([0.5, 1.0], n)
    turn = rng.uniform(0, 2 * np.pi, n // 2)
    tilt = math.acos(radius / b)  # from the axis, at the sphere's middle, to where rays from the pinhole touch it
    around = np.stack([np.cos(turn), np.sin(turn)])
    points[:, : n // 2] = radius * np.concatenate([math.sin(tilt) * around, np.full((1, n // 2), math.cos(tilt))])
    source = points - [[0], [0], [b]]
    hole = np.concatenate([crossing, np.zeros((1, n))])
    return Rays(source, source + (hole - source) * ((l - source[2]) / -source[2]))


def disc(rng, n: int, low: float, high: float) -> np.ndarray:
    """Return points (2, n) evenly distributed over a ring: one in each of n rings of equal area."""
    share = rng.permutation((np.arange(n) + rng.random(n)) / n)
    radius, turn = np.sqrt(low**2 + share * (high**2 - low**2)), rng.uniform(0, 2 * np.pi, n)
    return radius * np.stack([np.cos(turn), np.sin(turn)])


def rays_of(rng, system, m: int) -> tuple[Rays, Rays]:
    """Return rays from the ROI through the hole, and rays from the ROI and elsewhere that pass beside the hole."""
    d, l, side = system.pinhole_diameter[m], system.collimator_length[m], system.detector_side[m]
    through = from_roi(rng, system, m, disc(rng, N, 0, 0.9999 * d / 2))
    assert through.on_crystal.max() < side / 2 + 1e-6, "the design formula: all of them meet the crystal"
    near = from_roi(rng, system, m, disc(rng, 4 * N, 1.001 * d / 2, 3 * d))
    near = near[near.on_crystal < side / 2][np.arange(N // 2)]
    target = np.concatenate([rng.uniform(-side / 2, side / 2, (2, N)), np.full((1, N), l)])
    direction = rng.normal(size=(3, N))
    direction[2] = -np.abs(direction[2])  # to the front, everywhere
    anywhere = Rays(target + 400 * direction / np.linalg.norm(direction, axis=0), target)
    anywhere = anywhere[(np.hypot(*anywhere.crossing[:2]) > 1.001 * d / 2) & (anywhere.source[2] < -20)]
    return through, Rays(*(np.concatenate(pair, axis=1) for pair in zip(
        (near.source, near.target), (anywhere.source, anywhere.target), strict=True)))  # fmt: skip


def cut_by_triangles(rays: Rays, corners: np.ndarray) -> np.ndarray:
    """Return whether rays meet any of the triangles (F, 3, 3): Moeller and Trumbore 1997, with the rays' moments."""
    origin, along = rays.source.T, (rays.target - rays.source).T
    moment = np.cross(origin, along)
    a, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e1, e2)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = -1 / (along @ normal.T)
        u = (moment @ e2.T - along @ np.cross(e2, a).T) * scale
        v = (-moment @ e1.T - along @ np.cross(a, e1).T) * scale
        t = (origin @ normal.T - np.einsum("fi,fi->f", a, normal)) * scale
        return ((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1)).any(axis=1)


def world_to_module(system, m: int, points: np.ndarray) -> np.ndarray:
    """Return points (..., 3) of the world as u, v, depth."""
    u, v, k = system.frames()[m]
    return (points - system.centers[m]) @ np.stack([u, v, -k]).T


def assert_only_the_hole_is_open(through: Rays, past: Rays, cut) -> None:
    blocked = cut(through)
    assert blocked.mean() <= 0.01, f"{100 * blocked.mean():.2f} % of the hole's rays are blocked"
    assert cut(past).all(), "a ray passes beside the hole"


@pytest.mark.parametrize("place", PLACES)
def test_every_roi_ray_passes_the_mesh_and_the_stl_file_through_the_hole_alone(scanner, tmp_path, rng, place):
    trimesh = pytest.importorskip("trimesh")
    chosen = scanner[::9]
    mph.write_geometry(chosen, tmp_path / "stl", "stl-parts", part="collimators", edge_at=place)
    parts = [p for p in chosen.parts(Construction(edge_at=place)) if p.kind == "collimator"]
    for m, part in enumerate(parts):
        read = trimesh.load(tmp_path / "stl" / f"{part.name}.stl")
        assert read.is_watertight and read.is_winding_consistent and read.volume > 0
        through, past = rays_of(rng, chosen, m)
        drawn = world_to_module(chosen, m, part.vertices[part.triangles])
        written = world_to_module(chosen, m, np.asarray(read.triangles))
        for shape in (drawn, written):
            assert_only_the_hole_is_open(through, past, lambda rays, shape=shape: cut_by_triangles(rays, shape))


class Convex:
    """Frustum around z, square or round: half-widths at -z and +z, height; `center` in its mother."""

    def __init__(self, round_: bool, behind: float, before: float, height: float, center) -> None:
        self.round, self.behind, self.before, self.height = round_, behind, before, height
        self.center = np.asarray(center, float)[:, None]

    def interval(self, source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the fractions of rays' lengths between which rays (3, N) are inside; infinity, minus infinity: nowhere."""
        origin, along = source - self.center, target - source
        growth = (self.before - self.behind) / self.height
        middle = (self.before + self.behind) / 2
        low, high = np.full(source.shape[1], -np.inf), np.full(source.shape[1], np.inf)

        def within(offset, rate):  # offset + t rate <= 0
            nonlocal low, high
            with np.errstate(divide="ignore", invalid="ignore"):
                at = -offset / rate
            high = np.where(rate > 0, np.minimum(high, at), np.where((rate == 0) & (offset > 0), -np.inf, high))
            low = np.where(rate < 0, np.maximum(low, at), low)

        for sign in (-1, 1):
            within(sign * origin[2] - self.height / 2, sign * along[2])
        width, widening = middle + growth * origin[2], growth * along[2]
        if not self.round:
            for axis in (0, 1):
                for sign in (-1, 1):
                    within(sign * origin[axis] - width, sign * along[axis] - widening)
            return low, high
        # x^2 + y^2 <= (width + t widening)^2; no ray here is steeper than the cone's nappe is wide within its ends.
        a = along[0] ** 2 + along[1] ** 2 - widening**2
        b = origin[0] * along[0] + origin[1] * along[1] - width * widening
        c = origin[0] ** 2 + origin[1] ** 2 - width**2
        under = b * b - a * c
        with np.errstate(divide="ignore", invalid="ignore"):
            roots = np.sort((-b + np.array([[-1], [1]]) * np.sqrt(np.maximum(under, 0))) / a, axis=0)
        # Within the ends the inside is one interval: where a > 0 between the roots, else beyond one of them.
        first, last = np.full(len(low), np.inf), np.full(len(low), -np.inf)
        for start, stop in pairwise([low, *roots.clip(low, high), high]):
            t = (start + stop) / 2
            inside = (a * t * t + 2 * b * t + c <= 0) & (stop > start)
            first = np.where(inside, np.minimum(first, start), first)
            last = np.where(inside, np.maximum(last, stop), last)
        return first, last


def path_in_material(solid: Convex, air: list[Convex], rays: Rays) -> np.ndarray:
    """Return the length, mm, of each ray inside `solid` and outside all of the `air`, whose pieces do not overlap."""
    source, target = rays.source * [[1], [1], [-1]], rays.target * [[1], [1], [-1]]  # to the front: z = k
    low, high = solid.interval(source, target)
    low, high = np.maximum(low, 0), np.minimum(high, 1)
    length = np.maximum(high - low, 0)
    for piece in air:
        start, stop = piece.interval(source - solid.center, target - solid.center)
        length -= np.maximum(np.minimum(stop, high) - np.maximum(start, low), 0)
    return length * np.linalg.norm(target - source, axis=0)


Solids = dict[int, tuple[Convex, list[Convex]]]


def solids_in_modules(system, volumes: list) -> Solids:
    """Return each module's solid and the air in it. `volumes`: tuples (name, mother, is round, sizes, centres, frames)."""
    air: dict[str, list[Convex]] = {}
    for _, mother, round_, sizes, centers, _ in volumes:
        air.setdefault(mother, []).append(Convex(round_, *sizes, centers[0]))
    solids = {}
    for name, _, round_, sizes, centers, frames in volumes:
        if name.startswith("collimator_"):
            for center, frame in zip(centers, frames, strict=True):
                m = int(np.argmin(np.linalg.norm(system.centers - center, axis=1)))
                np.testing.assert_allclose(frame, system.frames()[m], atol=1e-6)
                place = world_to_module(system, m, np.asarray(center)) * [1, 1, -1]
                solids[m] = Convex(round_, *sizes, place), air[name]
    return solids


def gate9_solids(folder, system) -> Solids:
    """Read the solids from the macros."""
    return solids_in_modules(system, [
        (name, v.mother, v.shape == "cone", v.sizes(), v.centers, v.frames)
        for name, v in Macros(folder).volumes.items() if "collimator_" in name + v.mother
    ])  # fmt: skip


def gate10_solids(folder, system) -> Solids:
    """Read the solids from the script's numbers."""
    volumes = json.loads((folder / "simulation.json").read_text())["volumes"]
    volumes = [v for v in volumes if "collimator_" in v["name"] + v["mother"]]
    assert {v["shape"] for v in volumes} == {"trd", "cone"}
    return solids_in_modules(system, [
        (v["name"], v["mother"], v["shape"] == "cone", v["size_mm"], v["centers_mm"],
         np.transpose(v["rotations"], (0, 2, 1))) for v in volumes
    ])  # fmt: skip


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(("format", "read"), [("gate9", gate9_solids), ("gate10", gate10_solids)])
def test_every_roi_ray_passes_the_solids_of_gate_through_the_hole_alone(scanner, tmp_path, rng, format, read, place):
    scanner = scanner[::4]
    mph.write_geometry(scanner, tmp_path / "gate", format, views=scanner.views((4, 4), "real"), edge_at=place)
    solids = read(tmp_path / "gate", scanner)
    assert sorted(solids) == list(range(len(scanner)))
    for m, (solid, air) in solids.items():
        through, past = rays_of(rng, scanner, m)
        assert_only_the_hole_is_open(through, past, lambda rays, s=solid, a=air: path_in_material(s, a, rays) > 1e-7)


def test_the_path_through_the_drawn_plate_is_that_of_the_physics(scanner, tmp_path, rng):
    """Beside the rim, where a ray leaves the edge within the plate, GATE's solid attenuates it as `KnifeEdge` does."""
    mu, plate = 2.0, 6.0
    mph.write_geometry(
        scanner, tmp_path / "gate", "gate10", views=scanner.views((4, 4), "real"), plate_thickness=plate,
        wall_thickness=5.0, opening_degrees=80,
    )  # fmt: skip
    solid, air = gate10_solids(tmp_path / "gate", scanner)[7]
    d, l = scanner.pinhole_diameter[7], scanner.collimator_length[7]
    knife = KnifeEdge(d / 2, mu, math.tan(math.radians(40)))
    for x, y in disc(rng, 40, d / 2, d / 2 + 1.0).T:
        slopes = disc(rng, 20, 0, 0.3)
        hole = np.array([[x], [y], [0]]) + np.zeros((1, 20))
        step = np.concatenate([slopes, np.ones((1, 20))])
        rays = Rays(hole - 100 * step, hole + 0.999 * l * step)
        expected = knife.transmission(x, y, *slopes)
        np.testing.assert_allclose(np.exp(-mu * path_in_material(solid, air, rays)), expected, rtol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("place", PLACES[:1])
def test_open_share_is_that_of_rays(scanner, rng, place):
    """Of random parallel rays through the hole, by the mesh; a straight hole of 2 mm loses a third and more at the rim."""
    m, (turn,) = 11, rng.uniform(0, 2 * np.pi, 1)
    d, l = scanner.pinhole_diameter[m], scanner.collimator_length[m]
    for degrees in (2.0, 30.0, 50.0):
        construction = Construction(2.0, 2.0, math.radians(degrees), place)
        part = scanner[m : m + 1].parts(construction)[0]
        corners = world_to_module(scanner, m, part.vertices[part.triangles])
        for slope in (0.0, 0.3, 0.5):
            hole = np.concatenate([disc(rng, 3000, 0, d / 2), np.zeros((1, 3000))])
            step = np.array([[slope * math.cos(turn)], [slope * math.sin(turn)], [1.0]])
            rays = Rays(hole - 60 * step, hole + 2.0 * step)  # as far as the plate may reach
            share = Collimator(d, l, scanner.detector_side[m], construction).open_share(slope)
            assert share == pytest.approx(1 - cut_by_triangles(rays, corners).mean(), abs=0.03)


def test_what_shades_the_roi_is_found_and_what_does_not_is_not(scanner):
    """The needed angle clears the hole for any plate; a degree less does not; a straight hole is open by 50 to 75 %."""
    scanner = scanner[::5]
    assert mph.check_geometry(scanner).vignetted == ()
    needed = list(map(needed_angle, scanner.pinhole_distance, scanner.pinhole_diameter, scanner.roi_radius))
    narrow = mph.check_geometry(scanner, opening_angle=math.radians(1), edge_at="front").vignetted
    assert [v.module for v in narrow] == scanner.numbers.tolist()
    assert [v.needed_angle for v in narrow] == pytest.approx(needed)
    assert 0.45 < min(v.open_share for v in narrow) < max(v.open_share for v in narrow) < 0.75
    for plate in (1.0, 10.0, 25.0):
        assert mph.check_geometry(scanner, plate_thickness=plate, opening_angle=max(needed)).vignetted == ()
    tight = mph.check_geometry(scanner, plate_thickness=25.0, opening_angle=max(needed) - math.radians(1)).vignetted
    assert 0 < len(tight) < len(scanner) and tight[0].open_share < 0.99
    assert "too thick for an opening angle of" in str(tight[0]) and not mph.check_geometry(scanner).messages()
    # The steepest ray, by brute force.
    rng = np.random.default_rng(3)
    m = int(np.argmin(scanner.pinhole_distance))
    d = scanner.pinhole_diameter[m]
    rays = from_roi(rng, scanner, m, disc(rng, 200_000, 0.99 * d / 2, d / 2))
    along = rays.target - rays.source
    steepest = 2 * np.arctan(np.hypot(along[0], along[1]) / along[2]).max()
    assert needed[m] - math.radians(0.2) < steepest < needed[m]


def test_a_plate_that_photons_pass_is_found(scanner):
    """Independent: areas and transmissions by numbers."""
    mu = mph.attenuation("lead", 364.5)
    report = mph.check_geometry(scanner, aperture_mu=mu)
    assert len(report.thin_plates) == len(scanner)
    d, through = 2.3, math.exp(-2 * mu)
    hole = math.pi / 4 * d * (d + 2 / mu)
    assert report.thin_plates[0].transmission == pytest.approx(through)
    beside = (2 * (d / 2 + 1 + 2)) ** 2 - math.pi * (d / 2 + 1) ** 2
    # The front is a little wider.
    assert report.thin_plates[0].share == pytest.approx(through * beside / hole, rel=0.15)
    assert "lets" in str(report.thin_plates[0])
    assert mph.check_geometry(scanner, aperture_mu=mph.attenuation("tungsten", 140.5)).ok


def test_command_names_plates_that_do_not_fit(workbook, tmp_path, command):
    check = ["geometry", "check", workbook]
    said = command(*check, "--opening-angle", 40, "--plate", 4, "--edge-at", "back", "--strict", status=1).out
    assert "a plate of 4 mm is too thick for an opening angle of 40 degrees" in said and "47.4 are needed" in said
    geometry = json.loads(command(*check, "--aperture-mu", "lead", "--isotope", "I-131", "--json").out)["geometry"]
    assert len(geometry["thin_plates"]) == 80 and geometry["vignetted"] == []
    assert "--isotope needs --aperture-mu" in command(*check, "--isotope", "I-131", status=1).err
    options = ["--format", "stl-parts", "--modules", "3", "--set", "edge_at=front", "--set", "opening_degrees=60"]
    command("geometry", "export", workbook, "-o", tmp_path / "stl", *options)
    assert len(list((tmp_path / "stl").iterdir())) == 2
