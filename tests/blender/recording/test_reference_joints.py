# SPDX-License-Identifier: GPL-3.0-or-later
"""The motion of the whole character changes no error, also where deforming bones have no parents."""

from collections.abc import Callable
from math import radians
from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters.base import tube
from blend_fixtures.characters.bones import (
    NewBone,
    add_bone_collection,
    add_bones,
    add_delta_mush,
    limit,
    remove_constraints,
)
from blend_fixtures.characters.training import SMALL
from fdda_addon.core.mathematics.metrics import distances
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.rig.reading import PoseEvaluator, read_model_rig
from fdda_addon.runtime.network import Network
from fdda_addon.scene.scene_rig import find_rig

from ..conftest import train


def copying_bones(parent: str = "") -> None:
    """Build a tube whose bones are children of `parent`, and copy control bones that "root" and "hips" carry."""
    mesh_object, armature_object = tube()
    start, joint, end = (0.0, 0.0, 0.0), (0.25, 0.0, 0.0), (0.5, 0.0, 0.0)
    add_bones(
        armature_object,
        NewBone("root", start, (0.0, 0.0, 0.1), is_deforming=False),
        NewBone("idle", start, (0.0, 0.0, 0.05), is_deforming=False),
        NewBone("hips", start, (0.0, 0.1, 0.0), "root", is_deforming=False),
        NewBone("control_upper", start, joint, "hips", is_deforming=False),
        NewBone("control_lower", joint, end, "control_upper", is_deforming=False),
    )
    bpy.context.view_layer.objects.active = armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    bones = armature_object.data.edit_bones
    for name in ("upper", "lower"):
        bones[name].use_connect, bones[name].parent = False, bones.get(parent)
    bpy.ops.object.mode_set(mode="OBJECT")
    for name in ("upper", "lower"):
        copy_transforms(name, f"control_{name}")
    limit(armature_object.pose.bones["control_upper"], "LIMIT_ROTATION", {0: (-20.0, 20.0)})
    limit(armature_object.pose.bones["control_lower"], "LIMIT_ROTATION", {0: (0.0, 90.0), 1: (-20.0, 20.0)})
    add_bone_collection(armature_object, "Controls", "control_upper", "control_lower")
    add_delta_mush(mesh_object)


def copy_transforms(name: str, source: str) -> None:
    armature_object = bpy.data.objects["elbow_rig"]
    bone = armature_object.pose.bones[name]
    remove_constraints(bone)
    constraint = bone.constraints.new("COPY_TRANSFORMS")
    constraint.target, constraint.subtarget = armature_object, source


def children_of_an_idle_bone() -> None:
    copying_bones("idle")


def parented_bones_and_prop() -> None:
    """Build a tube with a second root, a prop that follows the hand and moves vertices with it."""
    copying_bones()
    mesh_object, armature_object = bpy.data.objects["elbow"], bpy.data.objects["elbow_rig"]
    add_bones(armature_object, NewBone("prop", (0.5, 0.0, 0.1), (0.5, 0.0, 0.2)))
    follow = armature_object.pose.bones["prop"].constraints.new("CHILD_OF")
    follow.target, follow.subtarget = armature_object, "control_lower"
    follow.inverse_matrix = armature_object.pose.bones["control_lower"].matrix.inverted()
    group = mesh_object.vertex_groups.new(name="prop")
    group.add([vertex.index for vertex in mesh_object.data.vertices if vertex.co.x > 0.4], 0.5, "REPLACE")


def still_root() -> None:
    """Build a tube whose first bone is moved in no recorded pose."""
    copying_bones()
    armature_object = bpy.data.objects["elbow_rig"]
    armature_object.data.collections["Controls"].unassign(armature_object.data.bones["control_upper"])


@pytest.mark.parametrize("build", [copying_bones, children_of_an_idle_bone, parented_bones_and_prop, still_root])
def test_motion_of_the_character_changes_no_error(build: Callable[[], None], tmp_path: Path):
    build()
    bpy.context.view_layer.update()
    scene_rig = find_rig("elbow")
    settings = RecordingSettings(poses=60, bones_to_pose=("collection:Controls",), influence_poses=4)
    for _ in record(scene_rig, tmp_path / "recording", settings):
        pass
    recorded_rig = read_recording(tmp_path / "recording").rig
    assert (recorded_rig.references < 0).sum() == 1
    train(tmp_path / "recording", tmp_path / "elbow.onnx", "--passes", 10, *SMALL)
    network = Network(tmp_path / "elbow.onnx")
    assert network.info.joints == recorded_rig.joints
    assert [j.reference for j in network.info.joints] == [j.reference for j in recorded_rig.joints]
    evaluator, bones = (
        PoseEvaluator(scene_rig, read_model_rig(scene_rig, network.info)),
        scene_rig.armature_object.pose.bones,
    )
    errors = []
    for mover, distance, degrees in (("root", 0.0, 0.0), ("root", 0.1, 90.0), ("root", 1.0, 0.0), ("hips", 1.0, 180.0)):
        bones["root"].matrix_basis.identity(), bones["hips"].matrix_basis.identity()
        bones[mover].location, bones[mover].rotation_euler = (0.0, distance, 0.0), (0.0, radians(degrees), 0.0)
        bones["control_lower"].rotation_euler = (radians(70.0), radians(10.0), 0.0)
        pose_matrices, positions, controls = evaluator.evaluate()
        assert network.confidence(pose_matrices[None], controls[None]).min() > 0.999
        errors.append(distances(network.positions(pose_matrices[None], controls[None])[0], positions))
    np.testing.assert_allclose(errors, np.tile(errors[0], (4, 1)), atol=2e-6)
