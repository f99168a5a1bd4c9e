# SPDX-License-Identifier: GPL-3.0-or-later
"""Hides the differences between Blender's versions. All other code uses the API of 4.5."""

import bpy


def animation_curves(action: bpy.types.Action) -> list[bpy.types.FCurve]:
    """Return the F-curves of all slots of an action."""
    strips = (strip for layer in action.layers for strip in layer.strips)
    return [curve for strip in strips for channelbag in strip.channelbags for curve in channelbag.fcurves]


def accepts_slot(datablock: bpy.types.ID, slot: "bpy.types.ActionSlot") -> bool:
    """Return whether a slot can animate a datablock of this type."""
    return slot.target_id_type in {datablock.id_type, "UNSPECIFIED"}


def curves_of_slot(action: bpy.types.Action, slot: "bpy.types.ActionSlot") -> list[bpy.types.FCurve]:
    """Return the F-curves of a slot of an action."""
    channelbags = (strip.channelbag(slot) for layer in action.layers for strip in layer.strips)
    return [curve for channelbag in channelbags if channelbag is not None for curve in channelbag.fcurves]


def set_node_input(modifier: bpy.types.NodesModifier, identifier: str, value: object) -> None:
    """Set an input of a Geometry Nodes modifier by the identifier of its socket."""
    if hasattr(modifier, "properties") and hasattr(modifier.properties, "inputs"):
        getattr(modifier.properties.inputs, identifier).value = value
    else:
        modifier[identifier] = value


def node_input(modifier: bpy.types.NodesModifier, identifier: str) -> object:
    """Return the value of an input of a Geometry Nodes modifier; None if it has no such input."""
    if hasattr(modifier, "properties") and hasattr(modifier.properties, "inputs"):
        return getattr(getattr(modifier.properties.inputs, identifier, None), "value", None)
    return modifier.get(identifier)


def node_input_settings(modifier: bpy.types.NodesModifier) -> dict[str, tuple[str, object]]:
    """Return what defines the inputs of a Geometry Nodes modifier, by names that are the same in all versions.

    IDENTIFIER is the value of an input; it is left out if the input reads an attribute. IDENTIFIER_attribute is the
    name of this attribute, or empty.

    Returns:
        The RNA path by which each is animated, and its value; nothing for geometry, which has no value.
    """
    settings: dict[str, tuple[str, object]] = {}
    path, has_properties = modifier.path_from_id(), hasattr(getattr(modifier, "properties", None), "inputs")
    for item in modifier.node_group.interface.items_tree if modifier.node_group is not None else ():
        if item.item_type != "SOCKET" or item.in_out != "INPUT":
            continue
        name = item.identifier
        if has_properties and hasattr(socket := getattr(modifier.properties.inputs, name, None), "value"):
            attribute = socket.attribute_name if getattr(socket, "type", "") == "ATTRIBUTE" else ""
            socket_path = f"{path}.properties.inputs.{name}"
            value_path, attribute_path, value = f"{socket_path}.value", f"{socket_path}.type", socket.value
        elif not has_properties and name in modifier:
            reads_attribute = modifier.get(f"{name}_use_attribute", False)
            attribute = modifier.get(f"{name}_attribute_name", "") if reads_attribute else ""
            value_path, attribute_path, value = f'{path}["{name}"]', f'{path}["{name}_use_attribute"]', modifier[name]
        else:
            continue
        if not attribute:
            settings[name] = value_path, value
        settings[f"{name}_attribute"] = attribute_path, attribute
    return settings


def is_selected(bone: bpy.types.PoseBone) -> bool:
    """Return whether a bone is selected (5.0 and later store the selection in the pose bone)."""
    return selection_owner(bone).select


def select_bone(bone: bpy.types.PoseBone, selected: bool) -> None:
    """Select or deselect a bone."""
    selection_owner(bone).select = selected


def selection_owner(bone: bpy.types.PoseBone) -> "bpy.types.PoseBone | bpy.types.Bone":
    """Return the struct that has the property `select` of a bone."""
    return bone if hasattr(bone, "select") else bone.bone


def is_bone_hidden(bone: bpy.types.PoseBone) -> bool:
    """Return whether a bone is hidden in pose mode, by itself or by its collections."""
    return (bone.hide if hasattr(bone, "hide") else bone.bone.hide) or (
        not any(collection.is_visible_effectively for collection in bone.bone.collections)
        and bool(bone.bone.collections)
    )


def set_video_format(settings: bpy.types.ImageFormatSettings) -> None:
    """Set the output of a scene to a video, written by FFmpeg (5.0 and later distinguish media types)."""
    if hasattr(settings, "media_type"):
        settings.media_type = "VIDEO"
    settings.file_format = "FFMPEG"
