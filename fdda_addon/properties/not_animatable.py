# SPDX-License-Identifier: GPL-3.0-or-later
"""Properties that Blender lets nobody key or drive: nothing is called when animation sets a property."""

import bpy


def not_animatable(group: type[bpy.types.PropertyGroup]) -> type[bpy.types.PropertyGroup]:
    """Decorate a property group: keys and drivers are refused for its properties that do not state their options."""
    collections = (bpy.props.CollectionProperty, bpy.props.PointerProperty)
    for declared in group.__annotations__.values():
        if declared.function not in collections:
            declared.keywords.setdefault("options", set())
    return group
