"""Kernels that depend on the photons' direction: through the knife edge, and into the depth of the crystal.

The lines to a pixel that cross the edge up to some depth fill an ellipse in the hole's plane. So what the hole lets pass is
a sum of ellipses, each with the Fourier transform of a disc. A photon that is recorded at depth z in the crystal would have
met the image's plane, at the mean depth, elsewhere along its line: the deeper, the nearer to the axis, and the smaller is
the hole's shadow seen from there. Kernels are made for pixels at nodes, a lattice on the image, and the kernel of any pixel
is mixed from those of the four nodes around it.
"""

import functools
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..arrays import Array
from ..physics.aperture import KnifeEdge
from .depth_zone import DepthZone
from .directional_effects import DirectionalEffects
from .pixel_kernels import KernelSpectra, Pair, disc_transform, half_taps, spline_transform

# Attenuation in the edge beyond which photons are neglected, and the number of Gauss nodes in the depth of the crystal.
_MAX_ATTENUATION, _DEPTH_NODES = 7.5, 32
# Largest slope at which the edge is taken as a cone, in units of the cone's own slope; steeper lines are blocked.
_STEEPEST = 0.98
# Taps below this fraction of those inside the shadow are left out: tails are wide. Rows and columns at the rim in which no
# tap exceeds the second fraction, of the largest tap, are left out, too: they are ripples of the transform.
_SMALLEST_TAP, _STRAY_TAP = 3e-3, 3e-4
# Frequency, per cell, from which on the spline's blur is undone no further: fine cells do not have it.
_HIGHEST_FREQUENCY = 0.6


class ObliqueKernel(NamedTuple):
    """Numbers of one pixel's kernel besides those of `KernelShape`; lengths in cells, along v and u."""

    ellipse_forms: Array
    """(n, 3), squared diameters of the ellipses, as quadratic forms: coefficients of f_v^2, f_u^2 and f_v f_u."""
    ellipse_centers: Array
    """(n, 2), centres of the ellipses."""
    ellipse_weights: Array
    """(n,), fraction that each ellipse lets pass of what a disc of the hole's diameter would."""
    depth_shifts: Array
    """(k, 2), from the pixel to where photons of interaction depth k would have met the image's plane."""
    hole_scales: Array
    """(k,), relative change of the constant part d of the hole's shadow d (1 + l / h), seen from interaction depth k."""
    depth_weights: Array
    """(k,), fraction of the photons that interact at depth k, by quadrature."""
    mixing_variance: Array
    """(2,), variance, cells^2, that mixing between nodes adds to the depth shifts: mean of midway and at the nodes."""


class NodeLattice(NamedTuple):
    """Kernels of pixels at the nodes of a lattice on the image."""

    kernels: list[ObliqueKernel]
    """Numbers of the nodes' kernels, row by row."""
    shape: Pair
    """Number of nodes along v and u."""


def node_positions(n: int, spacing: int) -> Array:
    """Return the pixel numbers of the nodes along an axis of n pixels, `spacing` pixels apart."""
    return np.arange(max(2, -(-(n - 1) // spacing) + 1)) * float(spacing)


def zone_nodes(zone: DepthZone, effects: DirectionalEffects) -> NodeLattice:
    """Return the nodes' kernels of a zone with these effects."""
    nodes = (node_positions(n, zone.node_spacing) for n in zone.image_shape)
    v, u = (first + pitch * n for first, pitch, n in zip(zone.numbers.first, zone.numbers.pitch, nodes, strict=True))
    return NodeLattice([oblique_kernel(zone, effects, np.array([a, b])) for a in v for b in u], (len(v), len(u)))


def oblique_kernel(zone: DepthZone, effects: DirectionalEffects, position: Array) -> ObliqueKernel:
    """Return the numbers of the kernel of a pixel at `position`, (2,), mm along v and u on the crystal."""
    diameter, length, cell_size = zone.numbers.diameter, zone.numbers.length, zone.cell_size
    cells_per_pixel = np.array(zone.cells_per_pixel)
    slope = position / length
    steepness = float(np.hypot(*slope))
    axis = slope / steepness if steepness > 0 else np.array([1.0, 0.0])
    layer_weights, off_center = np.ones(1), np.zeros(1)
    across, along = np.full(1, diameter / 2), np.full(1, diameter / 2)
    if effects.knife is not None:
        softness = effects.edge_decay / float(np.abs(cell_size * cells_per_pixel).min())
        edge_slope = min(steepness, _STEEPEST * effects.knife.tangent)
        layer_weights, depths = _edge_layers(effects.knife, edge_slope, min(round(6 + 10 * softness), 32))
        along, off_center, across = _ellipses(effects.knife, depths, steepness, length)
    ellipse_weights = layer_weights * along * across / (diameter / 2) ** 2
    elongation = along**2 - across**2
    forms = 4 * (across**2)[:, None, None] * np.eye(2) + 4 * elongation[:, None, None] * np.outer(axis, axis)
    forms = forms / np.outer(cell_size, cell_size)
    depth_shifts, hole_scales, depth_weights, mixing_variance = np.zeros((1, 2)), np.zeros(1), np.ones(1), np.zeros(2)
    if effects.crystal_mu:
        nodes, gauss_weights = _gauss_nodes(_DEPTH_NODES)
        z = nodes * effects.thickness
        stretch = 1 + (z - effects.mean_depth) / length
        squared_secant = 1 + (steepness / stretch) ** 2
        rate = effects.crystal_mu * np.sqrt(squared_secant)
        density = rate * np.exp(-rate * z) / -np.expm1(-rate * effects.thickness)
        depth_weights = gauss_weights * effects.thickness * density / stretch**2
        # The pixel's factor has the pixel's direction; the photon's own takes its place.
        depth_weights = depth_weights * ((1 + steepness**2) / squared_secant) ** (1.5 * zone.pixel_exponent)
        hole_scales = 1 / stretch - 1
        depth_shifts = hole_scales[:, None] * position / cell_size
        variance = np.average((hole_scales - np.average(hole_scales, 0, depth_weights)) ** 2, 0, depth_weights)
        mixing_variance = variance * (zone.node_spacing * cells_per_pixel) ** 2 / 8
    ellipse_forms = np.stack([forms[:, 0, 0], forms[:, 1, 1], 2 * forms[:, 0, 1]], -1)
    ellipses = ellipse_forms, np.outer(off_center, axis) / cell_size, ellipse_weights
    return ObliqueKernel(*ellipses, depth_shifts, hole_scales, depth_weights, mixing_variance)


def balance_factors(zone: DepthZone, v: Array, u: Array) -> Array | float:
    """Return factors of cells at crystal positions v (n, 1) and u (m,), mm, that keep the totals of interaction depths.

    Photons of a depth are shifted by s times the position of the node, or pixel, that they are mixed for. So seen from the
    cells, nodes are 1 + s times as far apart as the linear shares with which they are mixed assume, and the shares sum to 1
    on average alone. The ripples about it are a Fourier series: of the shares' transform, times that of the point's image.
    """
    if zone.effects is None or not zone.effects.crystal_mu:
        return 1.0
    node, shape, spacing = oblique_kernel(zone, zone.effects, np.zeros(2)), zone.kernel_shape, zone.node_spacing
    stretch, scale = 1 + node.hole_scales, shape.image_scales.mean()
    photons = node.depth_weights / stretch**2
    numbers, orders, ripples = zone.numbers, np.arange(1.0, 1.5 * spacing + 1)[:, None], []
    for i, x in enumerate((v[:, 0], u)):
        per_pixel = orders / (spacing * stretch)
        per_cell = per_pixel / zone.cells_per_pixel[i]
        hole, _ = disc_transform((stretch + scale) * shape.hole_diameter[i] * per_cell)
        voxel = np.prod(np.sinc(scale * shape.voxel_edges[i] * per_cell[..., None]), axis=-1)
        image = hole * voxel / spline_transform(per_cell.clip(max=_HIGHEST_FREQUENCY), zone.cells_per_pixel[i])
        amplitudes = photons / photons.sum() * image * np.sinc(spacing * per_pixel) ** 2 / np.sinc(per_pixel)
        places = (x / stretch[:, None] - numbers.first[i]) / (numbers.pitch[i] * spacing)
        ripples.append(2 * np.einsum("nk,nkx->x", amplitudes, np.cos(2 * np.pi * orders[..., None] * places)))
    return np.asarray(1 - ripples[0][:, None] - ripples[1])


def _edge_layers(knife: KnifeEdge, slope: float, n: int) -> tuple[Array, Array]:
    """Return weights (n + 1,) and depths of the edge (n + 1,), mm along the axis, of a quadrature over its attenuation.

    The photons that pass are the sum of each weight times the area in which lines cross at most that depth.
    """
    rate = knife.mu * math.sqrt(1 + slope**2)
    plate_attenuation = np.inf if knife.plate is None else rate * knife.plate
    nodes, gauss_weights = _gauss_nodes(n)
    largest = min(_MAX_ATTENUATION, plate_attenuation)
    weights = largest * gauss_weights * np.exp(-largest * nodes)
    # The last layer is the rest: photons that would pass the solid plate are taken into account inside the hole alone.
    last_depth = largest + 0.5 if largest < plate_attenuation else 0.0
    return np.append(weights, math.exp(-largest)), np.append(largest * nodes, last_depth) / rate


def _ellipses(knife: KnifeEdge, depths: Array, slope: float, length: float) -> tuple[Array, Array, Array]:
    """Return half axis along the slope, offset of the centre along it, and half axis across of ellipses, mm.

    Each ellipse holds the lines that cross at most one of the `depths` of the edge. They meet in a point `length` behind the
    hole, so their slopes differ from place to place.
    """
    reaches, steepest = [], _STEEPEST * knife.tangent
    slope = min(slope, steepest)
    for outwards, across in ((slope, 0.0), (-slope, 0.0), (0.0, slope)):
        reach = knife.radius + 0 * depths
        for _ in range(6):  # the slope at the reach depends on the reach
            along = (outwards + reach / length).clip(-steepest, steepest)
            secant = np.sqrt((1 + along**2 + across**2) / (1 + slope**2))
            reach = knife.reach(depths / secant, along, across)
        reaches.append(reach)
    far, near, side = reaches
    return (far + near) / 2, (far - near) / 2, side


@functools.lru_cache(maxsize=8)
def _gauss_nodes(n: int) -> tuple[Array, Array]:
    """Return the n nodes and weights of Gauss's quadrature from 0 to 1."""
    x, w = np.polynomial.legendre.leggauss(n)  # type: ignore[no-untyped-call]
    return (x + 1) / 2, w / 2


def node_kernels(zone: DepthZone, effects: DirectionalEffects) -> Array:
    """Return the kernels (planes, nodes along v, nodes along u, taps, taps) of a zone with these effects."""
    nodes, node_list = zone_nodes(zone, effects), []
    spectra = ObliqueSpectra(zone, nodes, _half_taps(zone, nodes))
    for spectrum in spectra.node_spectra():
        images = spectra.to_taps(spectrum * spectra.pixel_and_voxel)
        node_list.append(_restore_centroid(spectra.kernel_taps(images).kernels, images[1:-1]))
    kernels = np.stack(node_list, axis=1)
    kernels *= spectra.totals[:, None, None]
    slices, is_used = [], (kernels > _STRAY_TAP * kernels.max()).any(axis=(0, 1))
    for axis, h in ((-1, spectra.half[0]), (-2, spectra.half[1])):
        used = np.flatnonzero(is_used.any(axis=axis))
        reach = min(max(h - used[0], used[-1] - h), h)
        slices.append(slice(h - reach, h + reach + 1))
    kernels = kernels[:, :, slices[0], slices[1]]
    return kernels.reshape(len(kernels), *nodes.shape, *kernels.shape[2:])


class NodeKernelGradient:
    """A loss that depends on the kernels of a zone's nodes, as a linear form of the numbers that these are made of.

    Near the zone given here the form changes as the loss does. `d_kernels` is the gradient by what `node_kernels` returns.
    """

    def __init__(self, zone: DepthZone, effects: DirectionalEffects, d_kernels: Array) -> None:
        nodes, n_planes = zone_nodes(zone, effects), len(d_kernels)
        spectra = ObliqueSpectra(zone, nodes, _half_taps(zone, nodes))
        self._half = spectra.half
        left_out = [(0, 0), *((h - n // 2,) * 2 for h, n in zip(spectra.half, d_kernels.shape[-2:], strict=True))]
        self._d_spectra, d_totals = [], []
        self._d_pixel_and_voxel = np.zeros(spectra.pixel_and_voxel.shape)
        self._d_curvature, self._d_smallest_tap = np.zeros(2), np.zeros(n_planes)
        d_nodes = d_kernels.reshape(n_planes, len(nodes.kernels), *d_kernels.shape[-2:]).swapaxes(0, 1)
        for d_node, spectrum, total in zip(d_nodes, spectra.node_spectra(), spectra.totals, strict=True):
            d_padded, images = np.pad(d_node, left_out), spectra.to_taps(spectrum * spectra.pixel_and_voxel)
            taps = spectra.kernel_taps(images)
            d_totals.append(np.vdot(d_padded, _restore_centroid(taps.kernels, images[1:-1])))
            d_taps, d_inner = _restore_centroid_gradient(d_padded * total, taps.kernels, images[1:-1])
            d_images, d_curvature, d_smallest_tap = spectra.kernel_taps_gradient(d_taps, images, taps)
            d_images[1:-1] += d_inner
            d_spectrum = spectra.to_taps_adjoint(d_images)
            self._d_pixel_and_voxel += (d_spectrum.conj() * spectrum).real
            self._d_curvature += d_curvature
            self._d_smallest_tap += d_smallest_tap
            self._d_spectra.append(d_spectrum)
        self._d_totals = np.array(d_totals)

    def value_by_edges(self, zone: DepthZone) -> float:
        """Return the linear form, up to a constant, for a zone that differs in the voxel's edges alone."""
        spectra = KernelSpectra(zone.kernel_shape, zone.cells_per_pixel, self._half)
        return float(np.vdot(self._d_pixel_and_voxel, spectra.pixel_and_voxel))

    def value(self, zone: DepthZone, effects: DirectionalEffects) -> float:
        """Return the linear form, which changes as the loss does, up to a constant, for another zone and other effects."""
        spectra = ObliqueSpectra(zone, zone_nodes(zone, effects), self._half)
        total = self._d_totals @ spectra.totals + self._d_curvature @ spectra.shape.curvature
        total += self._d_smallest_tap @ spectra.smallest_tap.ravel()
        for d_spectrum, spectrum in zip(self._d_spectra, spectra.node_spectra(), strict=True):
            total += np.vdot(d_spectrum, spectrum * spectra.pixel_and_voxel).real
        return float(total)


def _half_taps(zone: DepthZone, nodes: NodeLattice) -> Pair:
    """Return the number of taps on each side of the central one that suffices for all nodes of a zone."""
    shifts = np.max([np.abs(node.depth_shifts).max(axis=0) for node in nodes.kernels], axis=0)
    shape = zone.kernel_shape._replace(hole_diameter=_largest_diameters(nodes))
    return half_taps(shape, zone.cells_per_pixel, shifts)


def _restore_centroid(kernels: Array, images: Array) -> Array:
    """Return kernels (planes, taps, taps) with the centroid of the images; the faint end of a tail was cut off them.

    Each is multiplied by a factor that is linear along v and u, and not negative.
    """
    tilt = np.ones_like(kernels)
    for other_axis in (2, 1):
        sums = ((array.sum(axis=other_axis), array.sum(axis=(1, 2))[:, None]) for array in (kernels, images))
        profile, image_profile = (along / total for along, total in sums)
        taps = np.arange(profile.shape[1]) - profile.shape[1] // 2
        mean = (profile * taps).sum(axis=1, keepdims=True)
        off_mean = taps - mean
        missing = (image_profile * taps).sum(axis=1, keepdims=True) - mean
        variance = (profile * off_mean**2).sum(axis=1, keepdims=True)
        tilt += np.expand_dims(missing * off_mean / variance, other_axis)
    return np.asarray(kernels * tilt.clip(min=0))


def _weighted_mean(weights: Array, values: Array) -> Array:
    """Return the mean of `values` over the taps of each plane, (planes, 1, 1)."""
    total = (weights * values).sum(axis=(1, 2), keepdims=True)
    return np.asarray(total / weights.sum(axis=(1, 2), keepdims=True))


def _restore_centroid_gradient(d_result: Array, kernels: Array, images: Array) -> tuple[Array, Array]:
    """Return the gradients by the kernels and by the images from that by the result of `_restore_centroid`."""
    tilt, d_kernels, d_images = np.ones_like(kernels), np.zeros_like(kernels), np.zeros_like(images)
    moments = []
    for axis in (1, 2):
        taps = np.expand_dims(np.arange(kernels.shape[axis]) - kernels.shape[axis] // 2, 2 - axis)
        off_mean, off_image_mean = taps - _weighted_mean(kernels, taps), taps - _weighted_mean(images, taps)
        variance, missing = _weighted_mean(kernels, off_mean**2), _weighted_mean(images, off_mean)
        tilt += missing * off_mean / variance
        moments.append((off_mean, off_image_mean, variance, missing))
    d_tilt = d_result * kernels * (tilt > 0)
    for off_mean, off_image_mean, variance, missing in moments:
        d_missing = (d_tilt * off_mean).sum(axis=(1, 2), keepdims=True) / variance
        d_mean = -d_missing - missing / variance * d_tilt.sum(axis=(1, 2), keepdims=True)
        d_kernels += d_mean * off_mean - missing / variance * d_missing * (off_mean**2 - variance)
        d_images += d_missing * off_image_mean
    d_kernels /= kernels.sum(axis=(1, 2), keepdims=True)
    d_images /= images.sum(axis=(1, 2), keepdims=True)
    return d_kernels + d_result * tilt.clip(min=0), d_images


def _largest_diameters(nodes: NodeLattice) -> Array:
    """Return the largest diameters of all ellipses around the hole's centre, (2,), cells."""
    reaches = [np.sqrt(node.ellipse_forms[:, :2]) + 2 * np.abs(node.ellipse_centers) for node in nodes.kernels]
    return np.asarray(np.max([reach.max(axis=0) for reach in reaches], axis=0))


class ObliqueSpectra(KernelSpectra):
    """Spectra of the images of nodes. What the hole lets pass is computed at 3 x 3 nodes and is quadratic between these."""

    def __init__(self, zone: DepthZone, nodes: NodeLattice, half: Pair) -> None:
        super().__init__(zone.kernel_shape, zone.cells_per_pixel, half)
        self.nodes, columns = nodes, nodes.shape[1]
        chosen, self._bases = zip(*(_quadratic_basis(n) for n in nodes.shape), strict=True)
        holes = [[self._hole_spectrum(nodes.kernels[i * columns + j]) for j in chosen[1]] for i in chosen[0]]
        self._holes: Array = np.array(holes)
        passed = np.reshape([node.ellipse_weights.sum() for node in nodes.kernels], nodes.shape)
        self._interpolated_passed = self._bases[0] @ passed[np.ix_(*chosen)] @ self._bases[1].T
        exact = passed - sum(_second_difference(passed, axis) / 12 for axis in (0, 1))
        self.totals = exact.ravel() * [node.depth_weights.sum() for node in nodes.kernels]

    @property
    def smallest_tap(self) -> Array:
        """(planes, 1, 1), a fraction of the tap that a uniform kernel over the widest shadow and a pixel would have."""
        shadow = np.pi / 4 * _largest_diameters(self.nodes).prod() * (1 + self.shape.image_scales) ** 2
        return np.asarray(_SMALLEST_TAP / (shadow + math.prod(self.cells_per_pixel)))[:, None, None]

    def _hole_spectrum(self, node: ObliqueKernel) -> Array:
        """Return the spectrum of what passes the hole, (1 or 2, planes + 2, f_v, f_u).

        With interaction depths the second array is its derivative by `hole_scales`.
        """
        f_v, f_u = self.frequencies
        total: Array = 0.0  # type: ignore[assignment]
        for form, center, weight in zip(node.ellipse_forms, node.ellipse_centers, node.ellipse_weights, strict=True):
            radius = np.sqrt(np.maximum(form[0] * f_v**2 + form[1] * f_u**2 + form[2] * f_v * f_u, 0))
            disc, derivative = disc_transform((1 + self.image_scales) * radius)
            disc = weight * (np.stack([disc, radius * derivative]) if node.hole_scales.any() else disc[None])
            if center.any():
                along_axes = zip(center, self.frequencies, strict=True)
                v, u = (np.exp(-2j * np.pi * (1 + self.image_scales) * offset * f) for offset, f in along_axes)
                disc = disc * v * u
            total = total + disc
        return total

    def _depth_spectrum(self, node: ObliqueKernel) -> Array:
        """Return the factors (2, f_v, f_u) of the interaction depths, on the hole's spectrum and on its derivative."""
        axes = zip(node.depth_shifts.T, self.frequencies, strict=True)
        phases = [np.exp(-2j * np.pi * np.outer(shifts, f.ravel())) for shifts, f in axes]
        weights = np.stack([node.depth_weights, node.depth_weights * node.hole_scales]) / node.depth_weights.sum()
        total: Array = (phases[0] * weights[:, :, None]).swapaxes(1, 2) @ phases[1]
        f_v, f_u = self.frequencies
        return total * (1 + 2 * np.pi**2 * (node.mixing_variance[0] * f_v**2 + node.mixing_variance[1] * f_u**2))

    def node_spectra(self) -> Iterator[Array]:
        """Yield the spectra (planes + 2, f_v, f_u) of the nodes' images row by row, without `pixel_and_voxel`."""
        nodes = iter(self.nodes.kernels)
        for row_basis, passed_row in zip(self._bases[0], self._interpolated_passed, strict=True):
            row = _weighted_sum(row_basis, self._holes)
            for column_basis, passed in zip(self._bases[1], passed_row, strict=True):
                hole, depth = _weighted_sum(column_basis, row), self._depth_spectrum(next(nodes)) / passed
                total = hole[0] * depth[0]
                if len(hole) > 1:
                    total += hole[1] * depth[1]
                yield total


def _weighted_sum(weights: Array, arrays: Array) -> Array:
    """Return the weighted sum along the first axis; for few arrays this is faster than a product of matrices."""
    total: Array = arrays[0] * weights[0]
    for array, weight in zip(arrays[1:], weights[1:], strict=True):
        total += array * weight
    return total


def _second_difference(values: Array, axis: int) -> Array:
    """Return the second difference along an axis, of the shape of `values`; 0 along an axis of fewer than three."""
    if values.shape[axis] < 3:
        return np.zeros_like(values)
    ends = [(1, 1) if i == axis else (0, 0) for i in range(values.ndim)]
    return np.pad(np.diff(values, 2, axis=axis), ends, "edge")


def _quadratic_basis(n: int) -> tuple[list[int], Array]:
    """Return up to three of n nodes, and the weights (n, 3) with which quantities of these give those of all nodes.

    The interpolation is quadratic, less what linear mixing between nodes adds on average.
    """
    if n < 3:
        return list(range(n)), np.eye(n)
    chosen = [0, (n - 1) // 2, n - 1]
    factors = [[(np.arange(n) - b) / (a - b) for b in chosen if b != a] for a in chosen]
    bases = np.stack([np.prod(pair, axis=0) for pair in factors], axis=-1)
    return chosen, bases - np.diff(bases[:3], 2, axis=0) / 12
