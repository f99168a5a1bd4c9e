# SPDX-License-Identifier: GPL-3.0-or-later
"""Moving joints in groups finds the same influences as moving one after the other, in fewer evaluations."""

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
from fdda_addon.core import group_testing
from fdda_addon.core.patches import largest_norms
from fdda_addon.core.recording.index import read_index
from fdda_addon.recording import influences
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.run import record
from fdda_addon.rig.reading import PoseEvaluator
from fdda_addon.scene.scene_rig import find_rig

TRIALS = 4
MAX_TOLERANCE_RATIO = 1.5
"""Largest change, as a ratio of the tolerance, of an influence that only one of the two ways finds."""


def chains() -> None:
    """Build six chains of eight bones, which do not meet."""
    meshes.five_hundred_bones()


def chains_with_driven_keys(bones_of_chain: Callable[[int], list[str]], expression: str) -> None:
    """Let a shape key of each chain follow the rotations of bones, the variables `angle_0`, `angle_1`, … ."""
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
        for number, bone in enumerate(bones_of_chain(chain)):
            variable = driver.variables.new()
            variable.name = f"angle_{number}"
            variable.targets[0].id = armature_object
            variable.targets[0].data_path = f'pose.bones["{bone}"].rotation_euler[0]'
        driver.expression = expression


def chains_with_distant_influences() -> None:
    """Let the first bone of each chain drive a shape key of the next chain."""
    chains_with_driven_keys(lambda chain: [f"finger.{(chain - 1) % meshes.CHAINS:02}.00"], "angle_0")


def chains_with_switches() -> None:
    """Let a shape key of each chain follow the first of five bones of other chains that is rotated."""

    def bones_of_chain(chain: int) -> list[str]:
        return [
            f"finger.{(chain + number + 1) % meshes.CHAINS:02}.{(2 * chain + 3 * number) % 8:02}" for number in range(5)
        ]

    expression = "angle_4"
    for number in reversed(range(4)):
        expression = f"(angle_{number} if abs(angle_{number}) > 0.001 else {expression})"
    chains_with_driven_keys(bones_of_chain, expression)


def chains_that_copy_each_other() -> None:
    """Let each bone of a chain add the rotation of the same bone of the previous chain to its own."""
    chains()
    armature_object = bpy.data.objects["creature_rig"]
    for chain in range(1, meshes.CHAINS):
        for index in range(meshes.BONES_PER_CHAIN):
            copy = armature_object.pose.bones[f"finger.{chain:02}.{index:02}"].constraints.new("COPY_ROTATION")
            copy.target, copy.subtarget = armature_object, f"finger.{chain - 1:02}.{index:02}"
            copy.mix_mode, copy.owner_space, copy.target_space = "ADD", "LOCAL", "LOCAL"


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


def find_influences(
    monkeypatch: pytest.MonkeyPatch, folder: Path, is_grouped: bool, sample: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the (N, P) influences, and the changes of partitions in each evaluation as ratios of the tolerance."""
    changes, found = [], []

    def evaluate(evaluation, *arguments):
        group_changes = yield from original_evaluate(evaluation, *arguments)
        norms = largest_norms(group_changes, evaluation.patches.starts)
        changes.append(np.maximum.reduceat(norms, evaluation.patches.partition_starts, axis=1))
        return group_changes

    def test_groups(*arguments):
        found.append((yield from original_test_groups(*arguments)))
        return found[0]

    original_evaluate, original_test_groups = influences._GroupEvaluation.evaluate, influences._test_groups
    with monkeypatch.context() as patches:
        patches.setattr(influences._GroupEvaluation, "evaluate", evaluate)
        patches.setattr(influences, "_test_groups", test_groups)
        if not is_grouped:
            patches.setattr(group_testing, "MAX_INPUTS_PER_GROUP", 1000)
        settings = RecordingSettings(poses=1, influence_poses=TRIALS, detect_influences=True, sample=sample)
        for _ in record(find_rig(), folder, settings):
            pass
    return found[0], np.concatenate(changes)


@pytest.mark.parametrize(
    ("build", "sample", "max_needless"),
    [
        (chains, (), 0),
        (chains_with_distant_influences, (), 0),
        (chains_with_switches, (), 2),
        (chains_that_copy_each_other, (), 0),
        (chains_on_controls, ("collection:Controls",), 0),
    ],
    ids=lambda value: value.__name__ if callable(value) else "",
)
def test_groups_find_what_single_joints_find(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    build: Callable[[], None],
    sample: tuple[str, ...],
    max_needless: int,
):
    monkeypatch.setattr(meshes, "CHAINS", 6)
    monkeypatch.setattr(meshes, "BONES_PER_CHAIN", 8)
    build()
    found, group_changes = find_influences(monkeypatch, tmp_path / "groups", True, sample)
    expected, single_changes = find_influences(monkeypatch, tmp_path / "single", False, sample)
    assert expected.any() and len(single_changes) == TRIALS * len(expected)
    largest_changes = single_changes.reshape(TRIALS, *expected.shape).max(axis=0)
    assert np.array_equal(largest_changes > 1, expected)
    assert not (expected & ~found & (largest_changes > MAX_TOLERANCE_RATIO)).any()
    assert (found & ~expected & (largest_changes < 2 - MAX_TOLERANCE_RATIO)).sum() <= max_needless
    assert len(group_changes) < 0.9 * len(single_changes)


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

    monkeypatch.setattr(PoseEvaluator, "evaluate", evaluate_with_fault)
    settings = RecordingSettings(poses=4, detect_influences=True)
    notes = [step.note for step in record(scene_rig, tmp_path / "recording", settings) if step.note]
    recording = read_index(tmp_path / "recording")
    names = [joint["name"] for joint in recording["joints"]]
    (upper,) = [p for p in recording["partitions"] if names[p["joint"]] == "upper"]
    assert (names.index("lower") in upper["influencing"]) == is_broken
    assert len(notes) == is_broken
    assert all("are not finite in " in note and "'lower' move from the rest pose" in note for note in notes)
