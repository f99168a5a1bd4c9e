# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes of a rig after which its model no longer fits: made in edit mode, and made by a script."""

from collections.abc import Callable

import bpy
import numpy as np

from blend_fixtures.characters.base import drive

from .conftest import ELBOW, ELBOW_RIG

REST_POSE_OF, WEIGHTS_DIFFER = "the rest pose of the", "the skin weights differ"


def change_in_edit_mode(scene_object: bpy.types.Object, change: Callable[[], object]) -> None:
    """Change an object in edit mode without an evaluation in between."""
    bpy.context.view_layer.objects.active = scene_object
    bpy.ops.object.mode_set(mode="EDIT")
    change()
    bpy.ops.object.mode_set(mode="OBJECT")


def edit_bones() -> bpy.types.ArmatureEditBones:
    return bpy.data.objects[ELBOW_RIG].data.edit_bones


def add_bone(name: str, parent: str = "") -> None:
    bone = edit_bones().new(name)
    bone.head, bone.tail = (1, 0, 0), (1, 0, 0.3)
    bone.parent = edit_bones().get(parent)


def change_bone_roll():
    edit_bones()["lower"].roll += 0.4


def change_bone_head():
    edit_bones()["lower"].head.x += 0.05


def remove_bone_parent():
    edit_bones()["lower"].parent = None


def replace_joint():
    edit_bones().remove(edit_bones()["lower"])
    add_bone("other", "upper")


def sort_vertices():
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.sort_elements(type="REVERSE", elements={"VERT"})


def exchange_mesh():
    mesh = bpy.data.meshes["elbow"].copy()
    mesh.vertices.foreach_set("co", np.random.default_rng(0).random(3 * len(mesh.vertices)).astype(np.float32))
    bpy.data.objects[ELBOW].data = mesh


def scale_positions():
    mesh = bpy.data.objects[ELBOW].data
    positions = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", positions)
    mesh.vertices.foreach_set("co", positions * 1.1)


def move_reference_key():
    bpy.data.objects[ELBOW].data.shape_keys.reference_key.data[0].co.x += 0.05


def flip_faces():
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.flip_normals()


def vertex_groups() -> bpy.types.VertexGroups:
    return bpy.data.objects[ELBOW].vertex_groups


def remove_vertex_group():
    vertex_groups().remove(vertex_groups()["lower"])


def rename_bone():
    bpy.data.objects[ELBOW_RIG].data.bones["lower"].name = "elsewhere"


NO_BONE_FOLLOWED = "some vertices follow no bone"

EDIT_MODE_CHANGES = {
    "roll": (ELBOW_RIG, change_bone_roll, f"{REST_POSE_OF} armature differs"),
    "head": (ELBOW_RIG, change_bone_head, f"{REST_POSE_OF} armature differs"),
    "parent": (ELBOW_RIG, remove_bone_parent, "its joints have other parents"),
    "exchanged joint": (ELBOW_RIG, replace_joint, "the armature lacks the joint 'lower'"),
    "sorted vertices": (ELBOW, sort_vertices, f"{REST_POSE_OF} mesh differs"),
    "flipped faces": (ELBOW, flip_faces, "the topology of the mesh differs"),
}

SCRIPT_CHANGES = {
    "another mesh": (exchange_mesh, f"{REST_POSE_OF} mesh differs"),
    "positions": (scale_positions, f"{REST_POSE_OF} mesh differs"),
    "weights": (lambda: vertex_groups()["lower"].add([0, 1], 0.3, "ADD"), WEIGHTS_DIFFER),
    "a weight": (lambda: change_weight(), WEIGHTS_DIFFER),
    "a group is gone": (remove_vertex_group, NO_BONE_FOLLOWED),
    "a group has another name": (lambda: setattr(vertex_groups()["lower"], "name", "elsewhere"), NO_BONE_FOLLOWED),
    "no deform": (
        lambda: setattr(bpy.data.objects[ELBOW_RIG].data.bones["lower"], "use_deform", False),
        NO_BONE_FOLLOWED,
    ),
    "an inverted group": (lambda: set_armature_modifier(vertex_group="upper"), NO_BONE_FOLLOWED),
    "no groups": (lambda: set_armature_modifier(use_vertex_groups=False, use_bone_envelopes=True), WEIGHTS_DIFFER),
    "preserve volume": (lambda: set_armature_modifier(use_deform_preserve_volume=True), "the modifier 'Armature'"),
    "bone name": (rename_bone, "the armature lacks the joint 'lower'"),
}


def change_weight():
    vertex = next(v for v in bpy.data.objects[ELBOW].data.vertices if len(v.groups) > 1 and v.groups[0].weight > 0.2)
    vertex.groups[0].weight *= 0.5


def set_armature_modifier(**settings: object) -> None:
    for name, value in settings.items():
        setattr(bpy.data.objects[ELBOW].modifiers["Armature"], name, value)


def trigger_check(update: str) -> None:
    if update == "frame":
        bpy.context.scene.frame_set(7)
    else:
        bpy.context.view_layer.update()


def drive_b_bone() -> None:
    """Drive a setting of the armature data by a bone, as Rigify does: Blender reports the data in every frame."""
    armature_object = bpy.data.objects[ELBOW_RIG]
    drive(armature_object.data, 'bones["lower"].bbone_easein', armature_object, ("lower", "ROT_X"))
    bpy.context.view_layer.update()


def paint_weight() -> None:
    bpy.data.objects[ELBOW].vertex_groups["upper"].add([0], 0.37, "REPLACE")
    bpy.data.objects[ELBOW].vertex_groups["lower"].add([0], 0.63, "REPLACE")
