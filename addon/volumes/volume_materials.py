"""Appearance of volumes: colours, display units, volume materials, and the density of the solid viewport's smoke.

Activity has the mosaic's colours, maps are green; attenuation and CT numbers look like a radiograph on slices and like
tissue as smoke, brighter for higher values. Maps have no hue of the crystals (`core.geometry.part_colors`) or of Blender's
selection.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...core.files import ensure_folder
from ...core.runs.display import Display
from ...core.volumes.volume import UNITS
from ..blender import objects
from ..blender.compat import add_math, add_node, blank_material

Ramp = tuple[tuple[float, tuple[float, ...]], ...]
"""Positions (0 to 1) and linear RGB colours."""

_SRGB = Display("inferno").colored(np.arange(17), (0, 16)) / 255  # the mosaic's default
_LINEAR = np.where(_SRGB <= 0.04045, _SRGB / 12.92, ((_SRGB + 0.055) / 1.055) ** 2.4)
_INFERNO: Ramp = tuple((step / 16, tuple(rgb)) for step, rgb in enumerate(_LINEAR.tolist()))
_GREENS = (
    (0.00, (0.0020, 0.0100, 0.0160)),
    (0.25, (0.0110, 0.0800, 0.1200)),
    (0.50, (0.0140, 0.2800, 0.2200)),
    (0.75, (0.1100, 0.5600, 0.1200)),
    (1.00, (0.6200, 0.7600, 0.0200)),
)
_GREYS = ((0.00, (0.02, 0.02, 0.02)), (1.00, (0.80, 0.80, 0.80)))
_TISSUES = (  # blood, muscle, fat and bone, for the smoke of CT numbers and mu
    (0.00, (0.0200, 0.0050, 0.0050)),
    (0.25, (0.2200, 0.0350, 0.0250)),
    (0.50, (0.5500, 0.1900, 0.1000)),
    (0.75, (0.8000, 0.5000, 0.2800)),
    (1.00, (0.9500, 0.8800, 0.7200)),
)
_FIRE = ((0.0, (0.004, 0.0, 0.0)), (0.4, (0.5, 0.01, 0.0)), (0.75, (0.9, 0.3, 0.01)), (1.0, (1.0, 0.9, 0.5)))
_ICE = ((0.0, (0.0, 0.002, 0.01)), (0.5, (0.0, 0.12, 0.5)), (1.0, (0.6, 0.9, 1.0)))
XRAY = ("mu", "hu")
# Units of the window where they differ from the voxels': the unit of every sensitivity, and a short word for images' units.
_DISPLAY_UNITS = {"sensitivity": ("cps/MBq", 1e6), "backprojection": ("as images", 1.0)}
_CT_WINDOW = (-200.0, 1000.0)  # HU: skin to bone
# Extinction times the volume's size: a rod of a twentieth of the size looks solid; attenuation and maps are transparent.
_OPACITY, _TRANSPARENT_OPACITY = 60.0, 20.0
_SMOKE = 15.0  # extinction times size of the solid viewport's smoke, which is denser: rods show behind rods
_VALUES, _LOOK, _COLORS = "Values", "Look", "Colors"  # names of nodes: the grid's values, the look, and its ramp
# A look's inputs. Low and High are the values at the ramp's ends; the extinction is relative value ** Exponent * Density /
# Size * Gain * Shown, where Shown is 0 in the part that is cut away.
_INPUTS = {
    "Value": 0.0, "Low": 0.0, "High": 1.0, "Density": _OPACITY, "Size": 100.0, "Exponent": 1.0, "Gain": 1.0, "Shown": 1.0,
}  # fmt: skip
# Materials of versions without looks have these inputs in other nodes: the node's name and the input's index.
_LEGACY = {"Low": ("Display Range", 1), "High": ("Display Range", 2), "Exponent": ("Exponent", 1), "Gain": ("Gain", 1)}
_LOOKS: dict[str, Ramp] = {
    "mphDRR Inferno": _INFERNO, "mphDRR Greens": _GREENS, "mphDRR Greys": _GREYS,
    "mphDRR Tissues": _TISSUES, "mphDRR Fire": _FIRE, "mphDRR Ice": _ICE,
}  # fmt: skip
_ICON = 128  # pixels
_CUT = "Cut"  # nodes of the three planes, numbered by grid axis; the part in front of all three is cut away
_MIN_DENSITY = 1e-5  # Blender's smallest density of smoke
_NO_CUT = 1e9  # a plane's position, beyond every volume, at which nothing is cut

Cut = Sequence[tuple[Sequence[float], float]]
"""A vector n and a number t for each grid axis: a point x, mm in the object's space, is cut away if n x > t on all axes."""


def ramp(quantity: str, smoke: bool = False) -> Ramp:
    """Return the positions (0 to 1) and colours (linear RGB) of a quantity's display range, on slices or as smoke."""
    if quantity in XRAY:
        return _TISSUES if smoke else _GREYS
    return _INFERNO if quantity == "activity" else _GREENS


def display_unit(quantity: str) -> tuple[str, float]:
    """Return the unit in which the window shows a quantity, and the factor from the voxels' values to that unit."""
    return _DISPLAY_UNITS.get(quantity, (UNITS[quantity], 1.0))


def default_range(quantity: str, low: float, high: float) -> tuple[float, float]:
    """Return the initial display range of a volume with values from `low` to `high`."""
    if quantity == "hu":
        return _CT_WINDOW
    return 0.0, high if high > 0 else max(-low, 1.0)


def new_material(name: str, quantity: str, size: float, look: str = "") -> bpy.types.Material:
    """Return a material that glows and is opaque where the grid `quantity` is high, for a volume of `size` mm.

    Its `look` is the name of a node group, by default the quantity's. `set_look_inputs` sets its range.
    """
    material = blank_material(name)
    look = look or next(key for key, colors in _LOOKS.items() if colors is ramp(quantity, smoke=True))
    tree = material.node_tree
    values = add_node(tree, "ShaderNodeAttribute", (0.0, 0.0), name=_VALUES, attribute_name=quantity).outputs["Fac"]
    position = add_node(tree, "ShaderNodeTexCoord", (-440.0, -660.0)).outputs["Object"]
    is_shown = add_math(tree, "SUBTRACT", (440.0, -726.0), 1.0, add_cut_nodes(tree, position), label="Not Cut Away")
    density = _OPACITY if quantity == "activity" else _TRANSPARENT_OPACITY
    inputs = {"Value": values, "Shown": is_shown, "Density": density, "Size": size}
    group = {"name": _LOOK, "label": look, "width": 200.0, "node_tree": _look_node_group(look)}
    look_node = add_node(tree, "ShaderNodeGroup", (660.0, 0.0), inputs, **group)
    add_node(tree, "ShaderNodeOutputMaterial", (920.0, 0.0), {"Volume": look_node.outputs[0]})
    material.diffuse_color = (*_LOOKS[look][-1][1], 1.0)  # colour of the solid viewport's smoke
    return material


def _look_node_group(name: str) -> bpy.types.NodeTree:
    """Return the node group of a look; an existing one keeps the user's changes."""
    if (tree := bpy.data.node_groups.get(name)) is not None:
        return tree
    tree, colors = bpy.data.node_groups.new(name, "ShaderNodeTree"), _LOOKS[name]
    for input_name, default in _INPUTS.items():
        tree.interface.new_socket(input_name, in_out="INPUT", socket_type="NodeSocketFloat").default_value = default
    tree.interface.new_socket("Volume", in_out="OUTPUT", socket_type="NodeSocketShader")
    inputs = add_node(tree, "NodeGroupInput", (-220.0, 0.0)).outputs
    range_inputs = {"Value": inputs["Value"], "From Min": inputs["Low"], "From Max": inputs["High"]}
    relative = add_node(tree, "ShaderNodeMapRange", (0.0, 0.0), range_inputs, clamp=True).outputs[0]
    color = add_node(tree, "ShaderNodeValToRGB", (220.0, 220.0), {"Fac": relative}, name=_COLORS)
    elements = color.color_ramp.elements
    while len(elements) < len(colors):
        elements.new(0.5)
    for element, (position, rgb) in zip(elements, colors, strict=True):
        element.position, element.color = position, (*rgb, 1.0)
    extinction = add_math(tree, "POWER", (220.0, -66.0), relative, inputs["Exponent"])
    opacity = add_math(tree, "DIVIDE", (0.0, -286.0), inputs["Density"], inputs["Size"], label="Opacity (1/mm)")
    for row, factor in enumerate((opacity, inputs["Gain"], inputs["Shown"])):
        extinction = add_math(tree, "MULTIPLY", (440.0, -66.0 - 180.0 * row), extinction, factor)
    black = {"Color": (0.0, 0.0, 0.0, 1.0), "Density": extinction}
    absorption = add_node(tree, "ShaderNodeVolumeAbsorption", (660.0, -132.0), black)
    glow = {"Color": color.outputs["Color"], "Strength": extinction}
    emission = add_node(tree, "ShaderNodeEmission", (660.0, 88.0), glow)
    shader = add_node(tree, "ShaderNodeAddShader", (880.0, 0.0), {0: absorption.outputs[0], 1: emission.outputs[0]})
    add_node(tree, "NodeGroupOutput", (1100.0, 0.0), {0: shader.outputs[0]})
    return tree


def set_look_inputs(material: bpy.types.Material, quantity: str, **inputs: float) -> None:
    """Make a material draw the grid `quantity` with these inputs of its look; materials made by the user are left alone."""
    if material.node_tree is None or material.library is not None:
        return
    nodes = material.node_tree.nodes
    if (values := nodes.get(_VALUES)) is not None:
        objects.change(values, attribute_name=quantity)
    for name, value in inputs.items():
        old_node, index = _LEGACY.get(name, ("", 0))
        if _LOOK in nodes and name in nodes[_LOOK].inputs:
            objects.change(nodes[_LOOK].inputs[name], default_value=value)
        elif old_node in nodes:
            objects.change(nodes[old_node].inputs[index], default_value=value)


def is_look(material: bpy.types.Material) -> bool:
    """Return whether a material draws volumes in a look."""
    return material.node_tree is not None and _LOOK in material.node_tree.nodes


def item_ramp(item: bpy.types.Object, smoke: bool = False) -> Ramp:
    """Return the positions and colours of a volume's display range as its material has them, on slices or as smoke.

    A volume whose smoke has tissues' colours is grey on slices.
    """
    quantity = item.mphdrr_volume.quantity
    for material in filter(None, item.data.materials):
        look = material.node_tree.nodes[_LOOK].node_tree if is_look(material) else None
        if look is not None and (node := look.nodes.get(_COLORS)):
            colors = tuple((element.position, tuple(element.color[:3])) for element in node.color_ramp.elements)
            is_tissues = np.allclose([c for _, c in colors], [c for _, c in _TISSUES]) if len(colors) == 5 else False
            return ramp(quantity, smoke) if is_tissues else colors
    return ramp(quantity, smoke)


def write_assets(folder: Path) -> Path:
    """Write the looks as materials for the Asset Browser into a folder and return the file."""
    materials = [new_material(name, "activity", 100.0, name) for name in _LOOKS]
    groups = [material.node_tree.nodes[_LOOK].node_tree for material in materials]
    for material, colors in zip(materials, _LOOKS.values(), strict=True):
        material.asset_mark()
        material.asset_data.description = "Drag it onto a volume: its display range goes along"
        positions, rgb = zip(*colors, strict=True)
        shades = [np.interp(np.linspace(0, 1, _ICON), positions, channel) ** (1 / 2.2) for channel in np.transpose(rgb)]
        icon = np.broadcast_to(np.stack([*shades, np.ones(_ICON)], axis=1), (_ICON, _ICON, 4))
        preview = material.preview_ensure()
        preview.image_size = _ICON, _ICON
        preview.image_pixels_float = icon.ravel().tolist()
    path = ensure_folder(folder) / "mphdrr-looks.blend"
    bpy.data.libraries.write(str(path), set(materials), fake_user=True)
    bpy.data.batch_remove(materials)
    objects.remove_unused(groups)
    return path


def add_cut_nodes(tree: bpy.types.NodeTree, position: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Add nodes to any kind of tree and return their output: 1 where the `position` is cut away (`set_cut`), else 0."""
    result: Any = None
    for axis in range(3):
        row, name = -660.0 - 180.0 * axis, f"{_CUT} {axis}"
        settings: dict[str, Any] = {"operation": "DOT_PRODUCT", "name": f"{name} along"}
        settings = add_node(tree, "ShaderNodeVectorMath", (-220.0, row), {0: position}, **settings).outputs["Value"]
        beyond = add_math(tree, "GREATER_THAN", (0.0, row), settings, _NO_CUT, name=name)
        result = beyond if result is None else add_math(tree, "MULTIPLY", (220.0, row), result, beyond)
    return result


def set_cut(tree: bpy.types.NodeTree, cut: Cut | None) -> None:
    """Cut away the part in front of the planes of all three axes; None cuts nothing."""
    for axis, (normal, threshold) in enumerate(cut or [((0.0, 0.0, 0.0), _NO_CUT)] * 3):
        dot, compare = tree.nodes.get(f"{_CUT} {axis} along"), tree.nodes.get(f"{_CUT} {axis}")
        if dot is not None and compare is not None:  # trees of earlier versions, or made by the user, have none
            objects.change(dot.inputs[1], default_value=normal)
            objects.change(compare.inputs[1], default_value=threshold)


def set_display(data: bpy.types.Volume, low: float, high: float, size: float, gain: float = 1.0) -> None:
    """Make the solid viewport draw the volume's values as smoke of a useful density times `gain`; 0 hides the smoke."""
    density = max(gain * _SMOKE / size / (high - low), _MIN_DENSITY)
    # Blender allows no density of 0: hidden smoke is very thin and cut to a slice at the volume's edge.
    hidden = {"use_slice": not gain, "slice_axis": "X", "slice_depth": 0.0}
    objects.change(data.display, density=density, **hidden, wireframe_type="NONE", interpolation_method="LINEAR")


def show_in_eevee(scene: bpy.types.Scene) -> None:
    """Make EEVEE draw volumes finely and beyond its default limit of 100 units; settings that were changed are kept."""
    eevee = scene.eevee
    if eevee.use_volume_custom_range and eevee.volumetric_end == 100.0:
        eevee.use_volume_custom_range = False
    if eevee.volumetric_tile_size == "8":
        eevee.volumetric_tile_size = "2"
    if eevee.volumetric_samples == 64:
        eevee.volumetric_samples = 128
