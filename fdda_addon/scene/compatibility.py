# SPDX-License-Identifier: GPL-3.0-or-later
"""What differs between Blender's versions, in one place. The rest of the code is written to the API of 4.5."""

import bpy


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
