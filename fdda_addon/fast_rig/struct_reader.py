# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads the datablocks and bones that a struct of Blender names, by all of its properties."""

from collections.abc import Iterator
from functools import cache

import bpy

from .dependency_graph import Node, datablock_key

_UNFOLLOWED_PROPERTIES = {"rna_type", "original", "library", "override_library", "animation_data"}


def datablock_node(datablock: bpy.types.ID) -> Node:
    """Return the node of a datablock."""
    library = datablock.library.filepath if datablock.library else ""
    return Node(datablock_key(datablock.id_type, datablock.name, library))


def bone_node(armature_object: bpy.types.Object, bone_name: str) -> Node:
    """Return the node of a bone of an armature object."""
    return Node(datablock_node(armature_object).datablock, bone=bone_name)


def is_armature(datablock: object) -> bool:
    """Return whether a datablock is an armature object."""
    return isinstance(datablock, bpy.types.Object) and datablock.type == "ARMATURE"


def struct_needs(struct: bpy.types.bpy_struct, *skipped: str) -> Iterator[Node]:
    """Yield the datablocks to which a struct and the structs in it point, and the bones that they name.

    A bone is named by a pointer, or by a text in a struct that points to its armature object.

    Args:
        struct: the struct, such as a constraint, a modifier or an object.
        skipped: names of properties of the struct that do not count.
    """
    pending, found = [struct], {struct}
    while pending:
        struct = pending.pop()
        followed = [name for name, leads in _properties(struct.bl_rna) if leads and name not in skipped]
        values = [value for name in followed for value in _elements(getattr(struct, name))]
        armature_objects = [value for value in values if is_armature(value)]
        for value in values:
            if isinstance(value, bpy.types.PoseBone):
                yield bone_node(value.id_data, value.name)
            elif isinstance(value, bpy.types.ID) and not value.is_embedded_data:
                yield datablock_node(value)
            elif value not in found:
                found.add(value)
                pending.append(value)
        texts = [getattr(struct, name) for name, leads in _properties(struct.bl_rna) if not leads]
        for armature_object in armature_objects:
            yield from (bone_node(armature_object, text) for text in texts if text in armature_object.data.bones)
        skipped = ()


def _elements(value: object) -> list[bpy.types.bpy_struct]:
    """Return the structs of a collection, or the struct to which a pointer points."""
    elements = value if isinstance(value, bpy.types.bpy_prop_collection) else [value]
    return [element for element in elements if element is not None]


def _properties(rna: bpy.types.Struct) -> list[tuple[str, bool]]:
    """Return the properties of a type of structs that are texts or lead to datablocks: the name, and if it leads."""
    if hasattr(bpy.types, rna.identifier):
        return _static_properties(rna.identifier, len(rna.properties))
    return _read_properties(rna)


@cache
def _static_properties(identifier: str, _count: int) -> list[tuple[str, bool]]:
    """Read the properties of a type of Blender's; add-ons change their number."""
    return _read_properties(getattr(bpy.types, identifier).bl_rna)


def _read_properties(rna: bpy.types.Struct) -> list[tuple[str, bool]]:
    return [
        (prop.identifier, prop.type != "STRING")
        for prop in rna.properties
        if (prop.type == "STRING" and prop != rna.name_property)
        or (_is_followed(prop) and _leads_to_datablocks(prop.fixed_type))
    ]


def _leads_to_datablocks(rna: bpy.types.Struct) -> bool:
    """Return whether structs of a type are datablocks or pose bones, or contain pointers to some."""
    if hasattr(bpy.types, rna.identifier):
        return rna.identifier in _leading_types()
    # Properties of add-ons and of node groups have types of their own.
    return any(_leads_to_datablocks(prop.fixed_type) for prop in rna.properties if _is_followed(prop))


@cache
def _leading_types() -> set[str]:
    """Return the names of the types for which `_leads_to_datablocks` is true, except those of add-ons."""
    users: dict[str, set[str]] = {}
    pending = ["PoseBone"]
    for rna in (t.bl_rna for name in dir(bpy.types) if hasattr(t := getattr(bpy.types, name), "bl_rna")):
        if issubclass(getattr(bpy.types, rna.identifier), bpy.types.ID):
            pending.append(rna.identifier)
        if rna.base is not None:
            users.setdefault(rna.identifier, set()).add(rna.base.identifier)
        for prop in filter(_is_followed, rna.properties):
            users.setdefault(prop.fixed_type.identifier, set()).add(rna.identifier)
    leading = set()
    while pending:
        name = pending.pop()
        if name not in leading:
            leading.add(name)
            pending += users.get(name, ())
    return leading


def _is_followed(prop: bpy.types.Property) -> bool:
    return prop.type in {"POINTER", "COLLECTION"} and prop.identifier not in _UNFOLLOWED_PROPERTIES
