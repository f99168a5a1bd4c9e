# SPDX-License-Identifier: GPL-3.0-or-later
"""Suggests controls of a rig, and reads their default values."""

import re

import bpy

from ..core.controls import ARMATURE_OBJECT, MESH_OBJECT, SHAPE_KEY_PATH, SHAPE_KEYS
from .bone_transform import bone_transform
from .controls import (
    custom_properties,
    custom_property_key,
    fcurve_target,
    is_custom_property,
    is_number,
    owner_name,
    owner_of,
    parent_and_name,
)
from .scene_rig import SceneRig

_FULL_DATA_PATH = re.compile(r'bpy\.data\.(?P<collection>\w+)\["(?P<name>(?:[^"\\]|\\.)*)"\]\.?(?P<path>.+)', re.DOTALL)


def control_at(scene_rig: SceneRig, full_data_path: str) -> str:
    """Return the name of the control at a full data path, as Blender's operator Copy Full Data Path writes it.

    Args:
        full_data_path: for example `bpy.data.objects["arm"].data.shape_keys.key_blocks["smile"].value`.

    Returns:
        The name of a shape key, or OWNER/PATH; the text itself if it is not the path of a number of the rig.
    """
    match = _FULL_DATA_PATH.fullmatch(full_data_path.strip())
    collection = getattr(bpy.data, match["collection"], None) if match else None
    if not isinstance(collection, bpy.types.bpy_prop_collection):
        return full_data_path
    datablock = collection.get(bpy.utils.unescape_identifier(match["name"]))
    if not is_number(datablock, match["path"]):
        return full_data_path
    struct_owner, path, _ = fcurve_target(datablock, match["path"])
    index = parent_and_name(datablock, match["path"])[2]
    owner = owner_name(scene_rig, struct_owner)
    shape_key = SHAPE_KEY_PATH.fullmatch(path) if owner == SHAPE_KEYS else None
    if shape_key:
        return bpy.utils.unescape_identifier(shape_key["name"])
    return f"{owner}/{path}{'' if index is None else f'[{index}]'}" if owner else full_data_path


def suggested_controls(scene_rig: SceneRig) -> list[str]:
    """Suggest the custom properties that no driver sets, and bone collections, as users list them."""
    mesh_object, armature_object = scene_rig.mesh_object, scene_rig.armature_object
    names = []
    for owner, datablock in ((ARMATURE_OBJECT, armature_object), (MESH_OBJECT, mesh_object)):
        names += [f"{owner}/{path}" for path in custom_properties(datablock, "")]
    for bone in armature_object.pose.bones:
        names += [f"{ARMATURE_OBJECT}/{path}" for path in custom_properties(armature_object, bone.path_from_id())]
    return [*names, *(f"collection:{collection.name}" for collection in armature_object.data.collections_all)]


def control_default(scene_rig: SceneRig, name: str) -> float:
    """Return the default value of a control; 0 for a shape key."""
    owner, _, path = name.partition("/")
    transform = bone_transform(path)
    if transform is not None and transform.is_matrix:
        return float(transform.element[0] == transform.element[1])
    struct, attribute, index = parent_and_name(owner_of(scene_rig, owner), path)
    if isinstance(struct, bpy.types.ShapeKey):
        return 0.0
    if is_custom_property(attribute):
        key = custom_property_key(attribute)
        default = False if isinstance(struct[key], bool) else struct.id_properties_ui(key).as_dict()["default"]
        return float(default[index] if hasattr(default, "__len__") else default)
    prop = struct.bl_rna.properties[attribute]
    return float(prop.default if index is None else prop.default_array[index])
