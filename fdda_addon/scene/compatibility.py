# SPDX-License-Identifier: GPL-3.0-or-later
"""What differs between Blender's versions, in one place. The rest of the code is written to the API of 4.5."""

import bpy

BLEND_RELATIVE_PATH = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5, 0) else set()
"""Option of a path property that may begin with `//`; older versions take such paths without being told."""


def animation_curves(action: bpy.types.Action) -> list[bpy.types.FCurve]:
    """All F-curves of an action, of all its slots (4.4 and later have layers and slots)."""
    if getattr(action, "layers", None):
        strips = (strip for layer in action.layers for strip in layer.strips)
        return [curve for strip in strips for bag in strip.channelbags for curve in bag.fcurves]
    return list(getattr(action, "fcurves", ()))


def set_node_input(modifier: bpy.types.NodesModifier, identifier: str, value: object) -> None:
    """Set an input of a Geometry Nodes modifier by the identifier of its socket."""
    if hasattr(modifier, "properties") and hasattr(modifier.properties, "inputs"):
        getattr(modifier.properties.inputs, identifier).value = value
    else:
        modifier[identifier] = value


def node_input(modifier: bpy.types.NodesModifier, identifier: str) -> object:
    """The value of an input of a Geometry Nodes modifier, None when it has no such input."""
    if hasattr(modifier, "properties") and hasattr(modifier.properties, "inputs"):
        return getattr(getattr(modifier.properties.inputs, identifier, None), "value", None)
    return modifier.get(identifier)
