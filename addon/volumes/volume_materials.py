"""How volumes look: colours, units, the volume material, and the density of the solid viewport's smoke.

Activity glows in purples, maps are green; attenuation and CT numbers look like a radiograph on slices and like tissue as
smoke, the higher the brighter. Neither activity nor maps have a hue of the crystals (`core.geometry.part_colors`) or of what
Blender marks as selected.
"""

from collections.abc import Sequence
from typing import Any

import bpy

from ...core.volumes.volume import UNITS
from ..blender import objects
from ..blender.compat import add_math, add_node, blank_material

# Positions and linear RGB, evenly brighter.
_PURPLES = (
    (0.00, (0.0060, 0.0020, 0.0180)),
    (0.25, (0.0500, 0.0090, 0.1750)),
    (0.50, (0.2700, 0.0180, 0.3000)),
    (0.75, (0.7800, 0.0700, 0.3600)),
    (1.00, (0.9500, 0.4800, 0.6800)),
)
_GREENS = (
    (0.00, (0.0020, 0.0100, 0.0160)),
    (0.25, (0.0110, 0.0800, 0.1200)),
    (0.50, (0.0140, 0.2800, 0.2200)),
    (0.75, (0.1100, 0.5600, 0.1200)),
    (1.00, (0.6200, 0.7600, 0.0200)),
)
_GREYS = ((0.00, (0.02, 0.02, 0.02)), (1.00, (0.80, 0.80, 0.80)))
_TISSUES = (  # of the smoke of CT numbers and mu: blood, muscle, fat, bone
    (0.00, (0.0200, 0.0050, 0.0050)),
    (0.25, (0.2200, 0.0350, 0.0250)),
    (0.50, (0.5500, 0.1900, 0.1000)),
    (0.75, (0.8000, 0.5000, 0.2800)),
    (1.00, (0.9500, 0.8800, 0.7200)),
)
XRAY = ("mu", "hu")
# Not in the voxels' own unit: as every other sensitivity in the window, and in few letters.
_SHOWN_AS = {"sensitivity": ("cps/MBq", 1e6), "backprojection": ("as images", 1.0)}
_CT_WINDOW = (-200.0, 1000.0)  # HU: skin to bone
# Extinction times the volume's size: a rod of a twentieth of it looks solid; attenuation and maps can be looked through.
_OPACITY, _OPACITY_THROUGH = 60.0, 20.0
_SMOKE = 15.0  # the same for the solid viewport's smoke, which is denser: thin enough that rods show behind rods
# Nodes: the values at the ramp's ends; the extinction, for relative values ** exponent and times a gain.
_RANGE, _OPACITY_NODE, _EXPONENT, _GAIN = "Display Range", "Opacity", "Exponent", "Gain"
_CUT = "Cut"  # nodes, numbered by the grid's axes: what lies beyond all three is cut away
_THINNEST = 1e-5  # Blender's least density of smoke
_FAR = 1e9  # where nothing is cut

Cut = Sequence[tuple[Sequence[float], float]]
"""A vector n and a number t for each axis of a grid; points x, mm in the object's space, with n x > t lie in front."""


def ramp(quantity: str, smoke: bool = False) -> tuple[tuple[float, tuple[float, float, float]], ...]:
    """Positions (0 to 1) and colours (linear RGB) that show a quantity's display range: on slices, or as smoke."""
    if quantity in XRAY:
        return _TISSUES if smoke else _GREYS
    return _PURPLES if quantity == "activity" else _GREENS


def shown_unit(quantity: str) -> tuple[str, float]:
    """The unit in which the window shows a quantity, and by what the voxels' values are multiplied for that."""
    return _SHOWN_AS.get(quantity, (UNITS[quantity], 1.0))


def usual_range(quantity: str, low: float, high: float) -> tuple[float, float]:
    """The display range that a volume with values from `low` to `high` begins with."""
    if quantity == "hu":
        return _CT_WINDOW
    return 0.0, high if high > 0 else max(-low, 1.0)


def new_material(name: str, quantity: str, size: float) -> bpy.types.Material:
    """A material that glows and is opaque where the grid `quantity` is high (`set_range`); for a volume of `size` mm."""
    material = blank_material(name)
    tree, colors = material.node_tree, ramp(quantity, smoke=True)
    attribute = add_node(tree, "ShaderNodeAttribute", (0.0, 0.0), attribute_name=quantity)
    ranged = {"Value": attribute.outputs["Fac"]}
    relative = add_node(
        tree, "ShaderNodeMapRange", (220.0, 0.0), ranged, name=_RANGE, label=_RANGE, clamp=True
    ).outputs[0]
    color = add_node(tree, "ShaderNodeValToRGB", (440.0, 220.0), {"Fac": relative})
    elements = color.color_ramp.elements
    while len(elements) < len(colors):
        elements.new(0.5)
    for element, (position, rgb) in zip(elements, colors, strict=True):
        element.position, element.color = position, (*rgb, 1.0)
    opacity = add_node(tree, "ShaderNodeValue", (220.0, -286.0), name=_OPACITY_NODE, label="Opacity (1/mm)").outputs[0]
    opacity.default_value = (_OPACITY if quantity == "activity" else _OPACITY_THROUGH) / size
    exponent = add_math(tree, "POWER", (440.0, -286.0), relative, 1.0, name=_EXPONENT, label=_EXPONENT)
    gain = add_math(tree, "MULTIPLY", (440.0, -506.0), opacity, 1.0, name=_GAIN, label=_GAIN)
    place = add_node(tree, "ShaderNodeTexCoord", (-440.0, -660.0)).outputs["Object"]
    kept = add_math(tree, "SUBTRACT", (440.0, -726.0), 1.0, in_front(tree, place), label="Not Cut Away")
    seen = add_math(tree, "MULTIPLY", (660.0, -506.0), gain, kept)
    extinction = add_math(tree, "MULTIPLY", (660.0, -66.0), exponent, seen)
    black = {"Color": (0.0, 0.0, 0.0, 1.0), "Density": extinction}
    absorption = add_node(tree, "ShaderNodeVolumeAbsorption", (880.0, -132.0), black)
    glow = {"Color": color.outputs["Color"], "Strength": extinction}
    emission = add_node(tree, "ShaderNodeEmission", (880.0, 88.0), glow)
    both = add_node(tree, "ShaderNodeAddShader", (1100.0, 0.0), {0: absorption.outputs[0], 1: emission.outputs[0]})
    add_node(tree, "ShaderNodeOutputMaterial", (1320.0, 0.0), {"Volume": both.outputs[0]})
    material.diffuse_color = (*colors[-1][1], 1.0)  # of the solid viewport's smoke
    return material


def set_range(material: bpy.types.Material, low: float, high: float) -> None:
    """Spread the colours from the value `low` to `high`; a material that the user made is left alone."""
    if material.node_tree and (node := material.node_tree.nodes.get(_RANGE)):
        objects.change(node.inputs["From Min"], default_value=low)
        objects.change(node.inputs["From Max"], default_value=high)


def in_front(tree: bpy.types.NodeTree, place: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Add nodes whose output is 1 where the `place` is cut away (`set_cut`), else 0; to any kind of tree."""
    result: Any = None
    for axis in range(3):
        row, name = -660.0 - 180.0 * axis, f"{_CUT} {axis}"
        dot: dict[str, Any] = {"operation": "DOT_PRODUCT", "name": f"{name} along"}
        along = add_node(tree, "ShaderNodeVectorMath", (-220.0, row), {0: place}, **dot).outputs["Value"]
        beyond = add_math(tree, "GREATER_THAN", (0.0, row), along, _FAR, name=name)
        result = beyond if result is None else add_math(tree, "MULTIPLY", (220.0, row), result, beyond)
    return result


def set_cut(tree: bpy.types.NodeTree, cut: Cut | None) -> None:
    """Cut away what lies in front along all three axes; None: nothing."""
    for axis, (normal, limit) in enumerate(cut or [((0.0, 0.0, 0.0), _FAR)] * 3):
        along, beyond = tree.nodes.get(f"{_CUT} {axis} along"), tree.nodes.get(f"{_CUT} {axis}")
        if along is not None and beyond is not None:  # a tree of an earlier version, or of the user's, has none
            objects.change(along.inputs[1], default_value=normal)
            objects.change(beyond.inputs[1], default_value=limit)


def set_opacity(material: bpy.types.Material, exponent: float, gain: float) -> None:
    """Make extinction follow a power of the relative values, times a gain."""
    for name, value in ((_EXPONENT, exponent), (_GAIN, gain)):
        if material.node_tree and (node := material.node_tree.nodes.get(name)):
            objects.change(node.inputs[1], default_value=value)


def resize(material: bpy.types.Material, old: float, new: float) -> None:
    """Keep a volume as opaque as before when its size, mm, changes from `old` to `new`."""
    if material.node_tree and (node := material.node_tree.nodes.get(_OPACITY_NODE)):
        node.outputs[0].default_value *= old / new


def set_display(data: bpy.types.Volume, low: float, high: float, size: float, gain: float = 1.0) -> None:
    """Make the solid viewport draw the volume's values as smoke of a useful density, times a gain, or none."""
    density = max(gain * _SMOKE / size / (high - low), _THINNEST)
    # Blender knows no density of 0, only very thin smoke: of that, no more than a slice at the edge.
    hidden = {"use_slice": not gain, "slice_axis": "X", "slice_depth": 0.0}
    objects.change(data.display, density=density, **hidden, wireframe_type="NONE", interpolation_method="LINEAR")


def show_in_eevee(scene: bpy.types.Scene) -> None:
    """Let EEVEE draw volumes beyond its default limit of 100 units, finely; settings that were changed are kept."""
    eevee = scene.eevee
    if eevee.use_volume_custom_range and eevee.volumetric_end == 100.0:
        eevee.use_volume_custom_range = False
    if eevee.volumetric_tile_size == "8":
        eevee.volumetric_tile_size = "2"
    if eevee.volumetric_samples == 64:
        eevee.volumetric_samples = 128
