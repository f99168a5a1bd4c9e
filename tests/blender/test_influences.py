# SPDX-License-Identifier: GPL-3.0-or-later
"""The joints that influence each partition are found by moving one after the other."""

from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import meshes
from blend_fixtures.characters.base import tube
from blend_fixtures.characters.bones import (
    NewBone,
    add_bone_collection,
    add_bones,
    limit,
)
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.skinned import skin_recording
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.rig.reading import PoseEvaluator
from fdda_addon.scene.scene_rig import find_rig

from .scene_state import drain


def chains() -> None:
    """Build six chains of eight bones, which do not meet."""
    meshes.five_hundred_bones()


def chains_with_distant_influences() -> None:
    """Let the first bone of each chain drive a shape key of the next chain."""
    chains()
    mesh_object, armature_object = bpy.data.objects["creature"], bpy.data.objects["creature_rig"]
    mesh_object.shape_key_add(name="Basis", from_mix=False)
    points = np.array([vertex.co for vertex in mesh_object.data.vertices])
    for chain in range(meshes.CHAINS):
        key = mesh_object.shape_key_add(name=f"key {chain}", from_mix=False)
        key.slider_min = -1.0
        for point, is_moved in zip(key.data, np.abs(points[:, 1] - chain * 0.05) < 0.02, strict=True):
            point.co.z += 0.05 if is_moved else 0.0
        driver = key.driver_add("value").driver
        driver.type = "SUM"
        target = driver.variables.new().targets[0]
        target.id = armature_object
        target.data_path = f'pose.bones["finger.{(chain - 1) % meshes.CHAINS:02}.00"].rotation_euler[0]'


def chains_on_controls() -> None:
    """Let control bones move all chains: the poses come from IK, a copied rotation and a control of all of them."""
    chains()
    armature_object = bpy.data.objects["creature_rig"]
    names = [f"control.{chain}" for chain in range(meshes.CHAINS)]
    add_bones(
        armature_object,
        *(
            NewBone(name, (0.5, chain * 0.05, 0.0), (0.6, chain * 0.05, 0.0), is_deforming=False)
            for chain, name in enumerate(names)
        ),
    )
    add_bone_collection(armature_object, "Controls", *names)
    bones = armature_object.pose.bones
    for chain, name in enumerate(names):
        if chain % 2:
            limit(bones[name], "LIMIT_LOCATION", {axis: (-0.1, 0.1) for axis in range(3)})
            ik = bones[f"finger.{chain:02}.{meshes.BONES_PER_CHAIN - 1:02}"].constraints.new("IK")
            ik.target, ik.subtarget = armature_object, name
            continue
        limit(bones[name], "LIMIT_ROTATION", {axis: (-20.0, 20.0) for axis in range(3)})
        for index in range(meshes.BONES_PER_CHAIN):
            copy = bones[f"finger.{chain:02}.{index:02}"].constraints.new("COPY_ROTATION")
            copy.target, copy.subtarget, copy.owner_space, copy.target_space = armature_object, name, "LOCAL", "LOCAL"


@pytest.mark.parametrize(
    ("build", "sample"),
    [(chains, ()), (chains_with_distant_influences, ()), (chains_on_controls, ("collection:Controls",))],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_joints_influence_their_chain_and_shape_keys_what_they_move(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, build: Callable[[], None], sample: tuple[str, ...]
):
    monkeypatch.setattr(meshes, "CHAINS", 6)
    monkeypatch.setattr(meshes, "BONES_PER_CHAIN", 8)
    build()
    settings = RecordingSettings(poses=1, bones_to_pose=sample)
    drain(record(find_rig(), tmp_path / "recording", settings))
    recording = skin_recording(read_recording(tmp_path / "recording"))
    chain_and_bone = [tuple(map(int, name.split(".")[1:])) for name in recording.rig.joint_names]
    keys = recording.rig.controls
    assert len(recording.recorded_positions) == 1 + settings.influence_poses * (1 + len(chain_and_bone)) + len(keys)
    for partition in recording.partitions:
        chain, bone = chain_and_bone[partition.joint]
        influencing = {chain_and_bone[joint] for joint in partition.influencing}
        # A bone that drives a shape key of another chain acts there through the value of the key alone.
        assert {joint for joint in influencing if joint[0] != chain} == set()
        key_values = [keys[control].path for control in partition.controls]
        assert key_values == ([f'key_blocks["key {chain}"].value'] if build is chains_with_distant_influences else [])
        # Delta mush lets the neighbors of a bone move its vertices.
        assert influencing & {(chain, bone - 1), (chain, bone + 1)}


@pytest.mark.parametrize("is_broken", [False, True])
def test_a_joint_that_makes_positions_infinite_is_an_influence(is_broken, tmp_path, monkeypatch):
    """Far from the bend, the surface of the upper bone does not depend on the lower bone."""
    tube()
    scene_rig, evaluate = find_rig(), PoseEvaluator.evaluate
    bend = scene_rig.armature_object.pose.bones["lower"]

    def evaluate_with_fault(evaluator: PoseEvaluator) -> tuple[np.ndarray, ...]:
        pose_matrices, positions, controls = evaluate(evaluator)
        if is_broken and bend.matrix_basis.to_quaternion().angle > 0.2:
            positions[:5] = np.nan
        return pose_matrices, positions, controls

    for step in record(scene_rig, tmp_path / "recording", RecordingSettings(poses=4)):
        # Other poses with positions that are not finite are refused.
        if step.done == 4:
            monkeypatch.setattr(PoseEvaluator, "evaluate", evaluate_with_fault)
    notes: list[str] = []
    recording = skin_recording(read_recording(tmp_path / "recording"), note=notes.append)
    names = recording.rig.joint_names
    (upper,) = [p for p in recording.partitions if names[p.joint] == "upper"]
    assert (names.index("lower") in upper.influencing) == is_broken
    assert len(notes) == is_broken
    assert all("are not finite in " in note and "'lower' moves from the rest pose" in note for note in notes)
