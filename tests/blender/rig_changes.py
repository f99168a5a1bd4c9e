# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes of a rig that its model does not follow: by hand in edit mode, and by a script."""

from collections.abc import Callable

import bpy
import numpy as np

from .conftest import ELBOW, ELBOW_RIG

REST, WEIGHTS = "the rest pose of the", "the skin weights differ"


def edit(scene_object: bpy.types.Object, change: Callable[[], object]) -> None:
    """Do something in edit mode, as a script: nothing is evaluated before it is over."""
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


def change_roll():
    edit_bones()["lower"].roll += 0.4


def change_head():
    edit_bones()["lower"].head.x += 0.05


def change_parent():
    edit_bones()["lower"].parent = None


def exchange_joint():
    edit_bones().remove(edit_bones()["lower"])
    add_bone("other", "upper")


def sort_vertices():
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.sort_elements(type="REVERSE", elements={"VERT"})


def other_mesh():
    mesh = bpy.data.meshes["elbow"].copy()
    mesh.vertices.foreach_set("co", np.random.default_rng(0).random(3 * len(mesh.vertices)).astype(np.float32))
    bpy.data.objects[ELBOW].data = mesh


def write_positions():
    mesh = bpy.data.objects[ELBOW].data
    positions = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", positions)
    mesh.vertices.foreach_set("co", positions * 1.1)


def move_key():
    bpy.data.objects[ELBOW].data.shape_keys.reference_key.data[0].co.x += 0.05


def flip_faces():
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.flip_normals()


def groups() -> bpy.types.VertexGroups:
    return bpy.data.objects[ELBOW].vertex_groups


def remove_group():
    groups().remove(groups()["lower"])


def rename_bone():
    bpy.data.objects[ELBOW_RIG].data.bones["lower"].name = "elsewhere"


NO_BONE = "some vertices follow no bone"

IN_EDIT_MODE = {
    "roll": (ELBOW_RIG, change_roll, f"{REST} armature differs"),
    "head": (ELBOW_RIG, change_head, f"{REST} armature differs"),
    "parent": (ELBOW_RIG, change_parent, "its joints have other parents"),
    "exchanged joint": (ELBOW_RIG, exchange_joint, "the armature lacks the joint 'lower'"),
    "sorted vertices": (ELBOW, sort_vertices, f"{REST} mesh differs"),
    "flipped faces": (ELBOW, flip_faces, "the topology of the mesh differs"),
}

BY_SCRIPT = {
    "another mesh": (other_mesh, f"{REST} mesh differs"),
    "positions": (write_positions, f"{REST} mesh differs"),
    "weights": (lambda: groups()["lower"].add([0, 1], 0.3, "ADD"), WEIGHTS),
    "a weight": (lambda: change_weight(), WEIGHTS),
    "a group is gone": (remove_group, NO_BONE),
    "a group has another name": (lambda: setattr(groups()["lower"], "name", "elsewhere"), NO_BONE),
    "no deform": (lambda: setattr(bpy.data.objects[ELBOW_RIG].data.bones["lower"], "use_deform", False), NO_BONE),
    "an inverted group": (lambda: set_modifier(vertex_group="upper"), NO_BONE),
    "no groups": (lambda: set_modifier(use_vertex_groups=False, use_bone_envelopes=True), WEIGHTS),
    "bone name": (rename_bone, "the armature lacks the joint 'lower'"),
}


def change_weight():
    vertex = next(v for v in bpy.data.objects[ELBOW].data.vertices if len(v.groups) > 1 and v.groups[0].weight > 0.2)
    vertex.groups[0].weight *= 0.5


def set_modifier(**settings: object) -> None:
    for name, value in settings.items():
        setattr(bpy.data.objects[ELBOW].modifiers["Armature"], name, value)
