# SPDX-License-Identifier: GPL-3.0-or-later
"""Build a face whose control bones deform it where no joint shows it, and an action of these bones."""

from collections.abc import Callable

import bpy
import numpy as np

from blend_fixtures.elbow import END, JOINT

from .base import add_key, drive, tube
from .bones import NewBone, add_bone_collection, add_bones, limit
from .targets import add_target_copy

ARMATURE, COLLECTION, SPEECH = "elbow_rig", "Face", "speech"
CONTROL_BONES = ("brow", "eye", "lid", "mouth", "still")
FRAMES = 40


def control_face() -> None:
    """Build a tube with two joints, and its target `flesh`, which alone has the face.

    Control bones in the collection `Face`: `brow` moves a bone of the target by a constraint, `eye` rotates one about
    three axes, `lid` drives a shape key by its angle and `mouth` another one by a property and its scale; `still` is
    locked.
    """
    mesh_object, armature_object = tube()
    flesh = add_target_copy(mesh_object)
    controls = [
        NewBone(name, (0.1 * n, 0.3, 0), (0.1 * n, 0.3, 0.05), "", False) for n, name in enumerate(CONTROL_BONES)
    ]
    follower_places = {"brow": 0.36, "eye": 0.44}
    followers = [NewBone(f"{name}_skin", (x, 0, 0), (x, 0, 0.05), "lower") for name, x in follower_places.items()]
    add_bones(armature_object, *controls, *followers)
    add_bone_collection(armature_object, COLLECTION, *CONTROL_BONES)
    bones = armature_object.pose.bones
    limit(bones["brow"], "LIMIT_LOCATION", {0: (-0.02, 0.02), 2: (-0.01, 0.03)})
    bones["eye"].rotation_mode = "QUATERNION"
    bones["eye"].lock_rotation = (False, False, False)
    limit(bones["lid"], "LIMIT_ROTATION", {1: (-90, 90)})
    limit(bones["mouth"], "LIMIT_SCALE", {2: (0.5, 1.5)})
    bones["mouth"]["smile"] = 0.0
    bones["mouth"].id_properties_ui("smile").update(min=-1.0, max=1.0)
    for name, place in follower_places.items():
        follow = bones[f"{name}_skin"].constraints.new("COPY_LOCATION" if name == "brow" else "COPY_ROTATION")
        follow.target, follow.subtarget = armature_object, name
        follow.owner_space = follow.target_space = "LOCAL"
        near = [vertex.index for vertex in flesh.data.vertices if abs(vertex.co.x - place) < 0.03]
        flesh.vertex_groups.new(name=f"{name}_skin").add(near, 1.0, "ADD")
    _add_key(flesh, "lid", lambda points: points * (1, 1.25, 1), 'pose.bones["lid"].rotation_euler[1]', "sin(value)")
    _add_key(flesh, "smile", lambda points: points + np.array([0, 0, 0.02]), 'pose.bones["mouth"]["smile"]', "value")
    _add_key(flesh, "open", lambda points: points + np.array([0, 0.02, 0]), 'pose.bones["mouth"].scale[2]', "value - 1")


def _add_key(
    flesh: bpy.types.Object, name: str, move: Callable[[np.ndarray], np.ndarray], path: str, expression: str
) -> None:
    """Add a shape key near the end of the target, and drive it with an expression of the number `value` at a path."""

    def move_end(points: np.ndarray) -> np.ndarray:
        return points + np.clip((points[:, :1] - JOINT) / (END - JOINT), 0, 1) * (move(points) - points)

    key = add_key(flesh, name, move_end)
    key.slider_min = -1.0
    drive(key, "value", bpy.data.objects[ARMATURE], path, expression)


def add_speech() -> bpy.types.Action:
    """Key the control bones and the lower bone in an action, and return it."""
    armature_object = bpy.data.objects[ARMATURE]
    bones = armature_object.pose.bones
    armature_object.animation_data_create().action = bpy.data.actions.new(SPEECH)
    random = np.random.default_rng(5)
    for frame in range(1, FRAMES + 1, 6):
        bones["brow"].location = (*random.uniform(-0.02, 0.02, 1), 0, *random.uniform(-0.01, 0.03, 1))
        rotation = np.array([1.0, *random.uniform(-0.4, 0.4, 3)])
        bones["eye"].rotation_quaternion = rotation / np.linalg.norm(rotation)
        bones["lid"].rotation_euler[1] = random.uniform(-1.2, 1.2)
        bones["mouth"]["smile"], bones["mouth"].scale[2] = random.uniform(-1, 1), random.uniform(0.6, 1.4)
        bones["lower"].rotation_euler[0] = random.uniform(0, 1.5)
        for name, path in (
            ("brow", "location"), ("eye", "rotation_quaternion"), ("lid", "rotation_euler"), ("mouth", "scale"),
            ("mouth", '["smile"]'), ("lower", "rotation_euler"),
        ):  # fmt: skip
            bones[name].keyframe_insert(path, frame=frame)
    return armature_object.animation_data.action


def many_control_bones() -> None:
    """Add 60 control bones with free rotations and limited locations to the tube, in the collection `Face`."""
    _, armature_object = tube()
    names = [f"control.{n:02}" for n in range(60)]
    add_bones(armature_object, *(NewBone(name, (0, 0.3, 0), (0, 0.3, 0.05), "", False) for name in names))
    add_bone_collection(armature_object, COLLECTION, *names)
    for bone in (armature_object.pose.bones[name] for name in names):
        bone.lock_rotation = (False, False, False)
        limit(bone, "LIMIT_LOCATION", {axis: (-0.1, 0.1) for axis in range(3)})
