# SPDX-License-Identifier: GPL-3.0-or-later
"""A decorator that makes properties not animatable: Blender calls no update function during animation."""

import bpy


def not_animatable(group: type[bpy.types.PropertyGroup]) -> type[bpy.types.PropertyGroup]:
    """Remove the option ANIMATABLE from the properties of a group that set no options themselves."""
    collections = (bpy.props.CollectionProperty, bpy.props.PointerProperty)
    for declared in group.__annotations__.values():
        if declared.function not in collections:
            declared.keywords.setdefault("options", set())
    return group
