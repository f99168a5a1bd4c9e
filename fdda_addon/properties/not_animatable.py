# SPDX-License-Identifier: GPL-3.0-or-later
"""A decorator that makes properties not animatable: animations would not call their update functions."""

import bpy


def not_animatable(property_group: type[bpy.types.PropertyGroup]) -> type[bpy.types.PropertyGroup]:
    """Remove the option ANIMATABLE from the properties of a group that set no options themselves."""
    nested_types = (bpy.props.CollectionProperty, bpy.props.PointerProperty)
    for property_definition in property_group.__annotations__.values():
        if property_definition.function not in nested_types:
            property_definition.keywords.setdefault("options", set())
    return property_group
