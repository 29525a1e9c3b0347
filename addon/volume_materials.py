"""How volumes look: the volume material, and the density of the solid viewport's smoke.

Activity glows in the colours of "inferno"; attenuation and CT numbers look like a radiograph, the higher the brighter.
"""

import bpy

from .compat import enable_nodes

# Positions and linear RGB of Matplotlib's "inferno" (CC0), without its pale end, which tone mapping would bleach.
_INFERNO = (
    (0.00, (0.0119, 0.0025, 0.0461)),
    (0.25, (0.0953, 0.0052, 0.1513)),
    (0.50, (0.5034, 0.0382, 0.0886)),
    (0.75, (0.8879, 0.1413, 0.0178)),
    (1.00, (0.9200, 0.4600, 0.0220)),
)
_GREYS = ((0.00, (0.02, 0.02, 0.02)), (1.00, (0.80, 0.80, 0.80)))
_XRAY = ("mu", "hu")
_CT_WINDOW = (-200.0, 1000.0)  # HU: skin to bone
# Extinction times the volume's size: a rod of a twentieth of it looks solid; attenuation and maps can be looked through.
_OPACITY, _OPACITY_THROUGH = 60.0, 20.0
_SMOKE = 15.0  # the same for the solid viewport's smoke, which is denser: thin enough that rods show behind rods
_RANGE, _OPACITY_NODE = "Display Range", "Opacity"  # nodes: the values at the ramp's ends, and the extinction


def ramp(quantity: str) -> tuple[tuple[float, tuple[float, float, float]], ...]:
    """Positions (0 to 1) and colours (linear RGB) that show a quantity's display range."""
    return _GREYS if quantity in _XRAY else _INFERNO


def usual_range(quantity: str, low: float, high: float) -> tuple[float, float]:
    """The display range that a volume with values from `low` to `high` begins with."""
    if quantity == "hu":
        return _CT_WINDOW
    return 0.0, high if high > 0 else max(-low, 1.0)


def new_material(name: str, quantity: str, size: float) -> bpy.types.Material:
    """A material that glows and is opaque where the grid `quantity` is high (`set_range`); for a volume of `size` mm."""
    material = bpy.data.materials.new(name)
    enable_nodes(material)
    tree = material.node_tree
    tree.nodes.clear()

    def node(kind: str, column: int, row: float = 0.0, **settings: object) -> bpy.types.Node:
        new = tree.nodes.new(kind)
        new.location = (column * 220.0, row * -220.0)
        for key, value in settings.items():
            setattr(new, key, value)
        return new

    attribute = node("ShaderNodeAttribute", 0, attribute_name=quantity)
    relative = node("ShaderNodeMapRange", 1, name=_RANGE, label=_RANGE, clamp=True)
    colors = ramp(quantity)
    color = node("ShaderNodeValToRGB", 2, -1)
    elements = color.color_ramp.elements
    while len(elements) < len(colors):
        elements.new(0.5)
    for element, (position, rgb) in zip(elements, colors, strict=True):
        element.position, element.color = position, (*rgb, 1.0)
    opacity = node("ShaderNodeValue", 1, 1.3, name=_OPACITY_NODE, label="Opacity (1/mm)")
    opacity.outputs[0].default_value = (_OPACITY if quantity == "activity" else _OPACITY_THROUGH) / size
    extinction = node("ShaderNodeMath", 2, 0.3, operation="MULTIPLY")
    absorption = node("ShaderNodeVolumeAbsorption", 4, 0.6)
    absorption.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    emission = node("ShaderNodeEmission", 4, -0.4)
    both = node("ShaderNodeAddShader", 5)
    output = node("ShaderNodeOutputMaterial", 6)

    link = tree.links.new
    link(attribute.outputs["Fac"], relative.inputs["Value"])
    link(relative.outputs["Result"], color.inputs["Fac"])
    link(relative.outputs["Result"], extinction.inputs[0])
    link(opacity.outputs[0], extinction.inputs[1])
    link(extinction.outputs[0], absorption.inputs["Density"])
    link(color.outputs["Color"], emission.inputs["Color"])
    link(extinction.outputs[0], emission.inputs["Strength"])
    link(absorption.outputs[0], both.inputs[0])
    link(emission.outputs[0], both.inputs[1])
    link(both.outputs[0], output.inputs["Volume"])
    material.diffuse_color = (*colors[-1][1], 1.0)  # of the solid viewport's smoke
    return material


def set_range(material: bpy.types.Material, low: float, high: float) -> None:
    """Spread the colours from the value `low` to `high`; a material that the user made is left alone."""
    if material.node_tree and (node := material.node_tree.nodes.get(_RANGE)):
        node.inputs["From Min"].default_value, node.inputs["From Max"].default_value = low, high


def resize(material: bpy.types.Material, old: float, new: float) -> None:
    """Keep a volume as opaque as before when its size, mm, changes from `old` to `new`."""
    if material.node_tree and (node := material.node_tree.nodes.get(_OPACITY_NODE)):
        node.outputs[0].default_value *= old / new


def set_display(data: bpy.types.Volume, low: float, high: float, size: float) -> None:
    """Make the solid viewport draw the volume's values as smoke of a useful density."""
    data.display.density = _SMOKE / size / (high - low)
    data.display.wireframe_type = "NONE"
    data.display.interpolation_method = "LINEAR"


def show_in_eevee(scene: bpy.types.Scene) -> None:
    """Let EEVEE draw volumes beyond its default limit of 100 units, finely; settings that were changed are kept."""
    eevee = scene.eevee
    if eevee.use_volume_custom_range and eevee.volumetric_end == 100.0:
        eevee.use_volume_custom_range = False
    if eevee.volumetric_tile_size == "8":
        eevee.volumetric_tile_size = "2"
    if eevee.volumetric_samples == 64:
        eevee.volumetric_samples = 128
