# SPDX-License-Identifier: GPL-3.0-or-later
"""Choice of key joints among joints that follow others, follow controls, stay still, or move freely."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fdda_addon.core.controls import Control
from fdda_addon.core.errors import RecordingError, TrainingError
from fdda_addon.core.formats.messages import KEY_JOINTS_STAGE
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.mathematics.poses import Channel
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.recording.index import RecordingInfo, Sampling, Source
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.skinned import SkinnedRecording
from fdda_addon.core.recording.writer import RecordingWriter
from fdda_addon.core.rig import STATIC_JOINT, Fingerprint, Joint, MeshPart, Rig
from trainer.config import TrainingConfig
from trainer.skin.fit_poses import FitPoses
from trainer.skin.key_joints import choose_key_joints
from trainer.skin.split_deformation import split_deformation

from ..recordings import alone_arrays, with_influences

BONES, RING = 4, 16
"""Number of main joints of the chain, and of vertices around each joint."""


class Sink:
    """Collects messages."""

    def __init__(self):
        self.messages: list[tuple] = []

    def send(self, message_type: object, **values: object) -> None:
        """Store a message."""
        self.messages.append((message_type, values))


def chain_poses(pose_count: int = 160, followers: tuple[str, ...] = ()) -> FitPoses:
    """Create random poses of a chain of main joints, each with one more joint below it for each kind of follower.

    Kinds: "half" rotates half as far as the next main joint, "slide" moves with a control, "free" rotates by itself,
    "still" does not move relative to its main joint.
    """
    rng = np.random.default_rng(0)
    vectors = rng.uniform(-0.4, 0.4, (pose_count, BONES, 3))
    slider = rng.uniform(-1, 1, pose_count)
    joints, local_matrices = [], []
    for bone in range(BONES):
        joints.append(Joint(str(bone), bone - 1))
        local_matrices.append(_transforms(vectors[:, bone], [0.2, 0, 0] if bone else [0, 0, 0]))
    for bone in range(BONES):
        for kind in followers:
            following = vectors[:, (bone + 1) % BONES]
            rotations = {"half": following / 2, "free": rng.uniform(-0.5, 0.5, (pose_count, 3))}
            matrices = _transforms(rotations.get(kind, np.zeros((pose_count, 3))), [0.2, 0, 0])
            if kind == "slide":
                matrices[:, 2, 3] += 0.05 * slider
            joints.append(Joint(str(len(joints)), bone))
            local_matrices.append(matrices)
    pose_matrices, rest_matrices = [], []
    for joint, matrices in zip(joints, local_matrices, strict=True):
        offset = np.eye(4)
        offset[0, 3] = 0.2 if joint.parent >= 0 else 0
        parent = pose_matrices[joint.parent] if joint.parent >= 0 else np.eye(4)
        pose_matrices.append(parent @ matrices)
        rest_matrices.append((rest_matrices[joint.parent] if joint.parent >= 0 else np.eye(4)) @ offset)
    rest = np.stack(rest_matrices).astype(np.float32)
    rig = _skinned_rig(tuple(joints), rest, rng)
    poses = np.stack(pose_matrices, axis=1).astype(np.float32)
    positions = LinearSkinning(rig).positions(poses)
    controls = slider[:, None].astype(np.float32)
    roles = np.zeros(len(joints), bool), np.arange(len(joints)) < BONES
    return FitPoses(rig, poses, positions, controls, *roles, pose_count)


def _transforms(vectors: np.ndarray, offset: list[float]) -> np.ndarray:
    matrices = np.tile(np.eye(4), (len(vectors), 1, 1))
    matrices[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix()
    matrices[:, :3, 3] = offset
    return matrices


def _skinned_rig(joints: tuple[Joint, ...], rest_matrices: np.ndarray, rng: np.random.Generator) -> Rig:
    """Return a rig with vertices around each joint, with most weight on it and the others on its parent."""
    count = len(joints)
    positions = np.repeat(rest_matrices[:, :3, 3], RING, axis=0) + rng.uniform(-0.06, 0.06, (RING * count, 3))
    skin_joints, weights = np.zeros((RING * count, 4), np.int32), np.zeros((RING * count, 4), np.float32)
    main = np.repeat(np.arange(count), RING)
    skin_joints[:, 0] = main
    skin_joints[:, 1] = np.maximum([joint.parent for joint in joints], 0)[main]
    weights[:, 0] = np.where(main == 0, 1, rng.uniform(0.6, 1, len(main)))
    weights[:, 1] = 1 - weights[:, 0]
    meshes = (MeshPart("mesh", len(positions), Fingerprint("", "", "")),)
    return Rig(joints, positions.astype(np.float32), rest_matrices, skin_joints, weights, meshes)


def choose(poses: FitPoses, requested: str = "auto"):
    return choose_key_joints(replace(poses, random_count=min(len(poses.positions), poses.random_count)), requested)


def needed_inputs(choice, vertices: slice) -> np.ndarray:
    """Return (v, K + C) bool, the inputs from which the motion of vertices follows that removed joints cause."""
    return choice.acts[vertices] @ choice.inputs[: choice.acts.shape[1]]


def test_half_rotating_joints_follow_from_the_main_joints():
    poses = chain_poses(followers=("half",))
    choice = choose(poses)
    # The half of the last main joint and its main joint rotate about other points, so one of them could be enough.
    assert len(choice.joints) == BONES and choice.report.unexplained_mm < choice.report.tolerance_mm
    # The vertices around a removed joint need the joint from whose rotation its own follows.
    for joint in set(range(BONES, 2 * BONES)) - set(choice.joints.tolist()):
        rotated = (joint - BONES + 1) % BONES
        if rotated in choice.joints:
            column = choice.joints.tolist().index(rotated)
            assert needed_inputs(choice, slice(RING * joint, RING * (joint + 1)))[:, column].all()


@pytest.mark.parametrize("noise", [0.002, 0.004])
def test_joints_that_nearly_follow_are_kept_where_the_rest_of_their_motion_shows(noise):
    """Their own rotations, at most `noise` radians, are below 5 % of their motion, but more than 0.01 % of the size."""
    poses = chain_poses(followers=("half",))
    vectors = np.random.default_rng(1).uniform(-noise, noise, (len(poses.positions) * BONES, 3))
    matrices = poses.pose_matrices.copy()
    matrices[:, BONES:] @= _transforms(vectors, [0, 0, 0]).reshape(-1, BONES, 4, 4).astype(np.float32)
    poses = replace(poses, pose_matrices=matrices, positions=LinearSkinning(poses.rig).positions(matrices))
    assert len(choose(poses).joints) == 2 * BONES
    unexplained = choose(poses, str(BONES)).report.unexplained_mm
    assert 1e-4 < unexplained / (1000 * poses.rig.size) < 6e-4


def test_independent_joints_are_all_kept():
    poses = chain_poses(followers=("free",))
    choice = choose(poses)
    assert len(choice.joints) == len(poses.rig.joints) and choice.report.independent == ()
    assert choice.report.sentence() == (
        f"Key joints: all {2 * BONES} joints are read, because each moves by more than "
        f"{choice.report.tolerance_mm:.2f} mm in ways that the others do not explain."
    )


def test_joints_that_follow_a_control_need_it_as_an_input():
    poses = chain_poses(followers=("slide",))
    choice = choose(poses)
    assert choice.joints.tolist() == list(range(BONES))
    needed = needed_inputs(choice, slice(None))
    assert needed[RING * BONES :, -1].all() and not needed[: RING * BONES, -1].any()
    # Without the control, one sliding joint shows how far the others slide.
    assert len(choose(replace(poses, controls=np.zeros((len(poses.controls), 1)))).joints) == BONES + 1


def test_still_joints_are_named():
    poses = chain_poses(followers=("still",))
    choice = choose(poses)
    names = tuple(joint.name for joint in poses.rig.joints[BONES:])
    assert choice.joints.tolist() == list(range(BONES)) and choice.report.still == names
    assert choice.report.sentence().endswith(
        f"No random pose moves {BONES} of the others ('{names[0]}', '{names[1]}', '{names[2]}' and {BONES - 3} more) "
        "relative to their parents, so the model does not show their own motion."
    )


def with_still_root(poses: FitPoses) -> FitPoses:
    """Return poses of a rig with one more joint: a root without weights that does not move."""
    rig, pose_count = poses.rig, len(poses.pose_matrices)
    joints = (Joint("root", -1), *(Joint(joint.name, joint.parent + 1) for joint in rig.joints))
    rest_matrices = np.concatenate([np.eye(4, dtype=np.float32)[None], rig.rest_matrices])
    matrices = np.tile(np.eye(4, dtype=np.float32), (pose_count, 1, 1, 1))
    return replace(
        poses,
        rig=replace(rig, joints=joints, rest_matrices=rest_matrices, skin_joints=rig.skin_joints + 1),
        pose_matrices=np.concatenate([matrices, poses.pose_matrices], axis=1),
        is_dependency=np.append(False, poses.is_dependency),
        is_sampled=np.append(False, poses.is_sampled),
    )


@pytest.mark.parametrize("requested", ["auto", "3"])
def test_a_root_that_does_not_move_stays_so_that_a_character_can_walk_with_it(requested):
    choice = choose(with_still_root(chain_poses(followers=("half", "still"))), requested)
    assert choice.joints[0] == 0
    assert len(choice.joints) == (BONES + 1 if requested == "auto" else 3)


@pytest.mark.parametrize("has_weights", [True, False])
def test_a_joint_that_stays_for_its_children_has_weights_only_if_it_has_some_in_the_rig(has_weights):
    """The joint 1 is between the first main joint and the second, and moves with the first."""
    poses, order = chain_poses(), [0, 0, *range(1, BONES)]
    joints = (Joint("0", -1), Joint("still", 0), *(Joint(str(index), index) for index in range(1, BONES)))
    skin_joints = poses.rig.skin_joints + (poses.rig.skin_joints > 0)
    skin_joints[:RING] = 1 if has_weights else 0
    poses = replace(
        poses,
        rig=replace(poses.rig, joints=joints, rest_matrices=poses.rig.rest_matrices[order], skin_joints=skin_joints),
        pose_matrices=poses.pose_matrices[:, order],
        is_dependency=poses.is_dependency[order],
        is_sampled=np.arange(BONES + 1) != 1,
    )
    choice = choose(poses)
    assert choice.joints.tolist() == list(range(BONES + 1))
    assert (1 in choice.weighted_joints) == has_weights
    assert set(choice.weighted_joints.tolist()) >= {0, *range(2, BONES + 1)}


def test_a_joint_that_only_actions_move_is_kept():
    poses, random_count, moved = chain_poses(followers=("still",)), 120, BONES + 1
    matrices = poses.pose_matrices.copy()
    matrices[random_count:, moved] @= _transforms(np.array([[0.0, 0.3, 0.0]]), [0, 0, 0])[0].astype(np.float32)
    poses = replace(poses, pose_matrices=matrices)
    choice = choose(replace(poses, random_count=random_count))
    assert choice.joints.tolist() == [*range(BONES), moved]
    assert choose(poses.subset(slice(0, random_count))).joints.tolist() == list(range(BONES))


def test_a_bone_is_left_besides_the_static_joint():
    poses = chain_poses()
    joints = (*poses.rig.joints[:-1], Joint(STATIC_JOINT, -1))
    choice = choose(replace(poses, rig=replace(poses.rig, joints=joints)), "1")
    assert len(choice.joints) == 2 and BONES - 1 in choice.joints


def test_a_joint_whose_weights_are_tiny_is_removed_although_it_is_free():
    poses = chain_poses(followers=("free",))
    weights = poses.rig.skin_weights.copy()
    joint = BONES
    rows = slice(RING * joint, RING * (joint + 1))
    weights[rows, 0], weights[rows, 1] = 1e-4, 1 - 1e-4
    rig = replace(poses.rig, skin_weights=weights)
    poses = replace(poses, rig=rig, positions=LinearSkinning(rig).positions(poses.pose_matrices))
    assert choose(poses).joints.tolist() == [index for index in range(2 * BONES) if index != joint]


def test_a_joint_without_weights_is_kept_if_it_moves_the_mesh_otherwise():
    poses = chain_poses(followers=("free",))
    joint = 2 * BONES - 1
    rig = replace(
        poses.rig,
        skin_weights=np.where(poses.rig.skin_joints == joint, 0, poses.rig.skin_weights),
    )
    rig = replace(rig, skin_weights=rig.skin_weights / rig.skin_weights.sum(axis=1, keepdims=True))
    poses = replace(poses, rig=rig, positions=LinearSkinning(rig).positions(poses.pose_matrices))
    assert joint not in choose(poses).joints
    is_dependency = np.arange(2 * BONES) == joint
    assert joint in choose(replace(poses, is_dependency=is_dependency)).joints


@pytest.mark.parametrize("count", [2, BONES, 2 * BONES, 100])
def test_a_number_of_joints_is_met_and_what_is_lost_is_told(count):
    poses = chain_poses(followers=("free",))
    choice = choose(poses, str(count))
    assert len(choice.joints) == min(count, 2 * BONES)
    removed = 2 * BONES - len(choice.joints)
    others = {joint.name for index, joint in enumerate(poses.rig.joints) if index not in choice.joints}
    assert set(choice.report.independent) == others and len(others) == removed
    if removed:
        assert f"but {removed} of the others ('" in choice.report.sentence()
        assert choice.report.unexplained_mm > 10


def test_a_scale_of_zero_is_refused():
    poses = chain_poses()
    matrices = poses.pose_matrices.copy()
    matrices[3, 2, :3, :3] = 0
    with pytest.raises(RecordingError, match="A bone has a scale of zero in some pose, so key joints cannot be chosen"):
        choose(replace(poses, pose_matrices=matrices))


def split(folder: Path, poses: FitPoses, random_count: int, **settings: object) -> tuple[SkinnedRecording, list]:
    """Record poses, split their deformation, and return the result and the messages."""
    sink, names = Sink(), poses.rig.joint_names
    channels = tuple(Channel(names[joint], "rotation", 0, -1.0, 1.0) for joint in np.flatnonzero(poses.is_sampled))
    counts = random_count, len(poses.positions) - random_count
    sources = Source("random", counts[0]), Source("action", counts[1], "walk", (1, 1))
    sampling = Sampling(0, 1.0, channels, tuple(source for source in sources if source.poses))
    controls = (Control("shape_keys", 'key_blocks["Slide"].value', -1.0, 1.0),)
    rig = replace(poses.rig, controls=controls)
    info = RecordingInfo(len(poses.positions), 0, "chain.blend", "5.2.0", sampling)
    with RecordingWriter(folder, rig, with_influences(info, rig)) as writer:
        writer.append(poses.pose_matrices, poses.positions, poses.controls)
        writer.append(*alone_arrays(rig, make_partitions(rig, {0: (len(names) - 1,)})))
    return split_deformation(read_recording(folder), TrainingConfig(**settings), sink), sink.messages


def test_weights_are_fitted_to_key_joints(tmp_path):
    poses = chain_poses(followers=("half", "still"))
    skinned, messages = split(tmp_path / "r", poses, 120, bones_to_read="auto")
    names, rig = poses.rig.joint_names, skinned.rig
    assert skinned.fit.key_joints.joints == len(rig.joints) == skinned.pose_matrices.shape[1] < len(names)
    assert rig.meshes[0].fingerprint.has_key_joints and set(rig.joint_names) < set(names)
    assert len(skinned.rows) == len(poses.positions) == skinned.info.poses
    residuals = skinned.compute_residuals(np.arange(len(poses.positions)))
    assert np.linalg.norm(residuals, axis=2).mean() < 0.02 * rig.size
    # What the last, removed joint moves follows from the inputs that explain it.
    explaining = [index for index, name in enumerate(rig.joint_names) if name == str(BONES - 1)]
    assert names[-1] not in rig.joint_names and set(explaining) <= set(skinned.partitions[0].influencing)
    searches = [values for _, values in messages if values.get("stage") == KEY_JOINTS_STAGE]
    assert {values["total"] for values in searches} == {len(names)}
    assert 0 <= min(values["done"] for values in searches) < max(values["done"] for values in searches) <= len(names)
    assert messages[-1][1]["text"] == skinned.fit.sentence()


@pytest.mark.parametrize("base_skinning", ["", "hard"])
def test_without_removable_joints_the_weights_are_the_own_or_fitted_ones(base_skinning, tmp_path):
    poses = chain_poses(followers=("free",))
    skinned, messages = split(tmp_path / "r", poses, 160, bones_to_read="auto", base_skinning=base_skinning)
    assert (skinned.fit.kind if skinned.fit else "") == base_skinning and skinned.key_joints.joints == 2 * BONES
    assert np.array_equal(skinned.rig.skin_weights, poses.rig.skin_weights) == (not base_skinning)
    assert skinned.key_joints.sentence() in [values.get("text") for _, values in messages]


def test_too_few_random_poses_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="at least 40 random poses, and the recording has 30"):
        split(tmp_path / "r", chain_poses(), 30, bones_to_read="auto")


def test_a_rig_without_weights_needs_a_fit(tmp_path):
    poses = chain_poses()
    joints = (*poses.rig.joints, Joint(STATIC_JOINT, -1))
    rest_matrices = np.concatenate([poses.rig.rest_matrices, np.eye(4, dtype=np.float32)[None]])
    matrices = np.tile(np.eye(4, dtype=np.float32), (len(poses.positions), 1, 1, 1))
    weights = np.eye(1, 4, dtype=np.float32).repeat(poses.rig.vertex_count, axis=0)
    static = np.full_like(poses.rig.skin_joints, BONES)
    bare = replace(poses.rig, joints=joints, rest_matrices=rest_matrices, skin_joints=static, skin_weights=weights)
    poses = replace(
        poses,
        rig=bare,
        pose_matrices=np.concatenate([poses.pose_matrices, matrices], axis=1),
        is_dependency=np.zeros(BONES + 1, bool),
        is_sampled=np.arange(BONES + 1) < BONES,
    )
    with pytest.raises(TrainingError, match=r"follow no bone by skin weights, .*--base-skinning smooth"):
        split(tmp_path / "r", poses, 160)
    skinned, _ = split(tmp_path / "fitted", poses, 160, base_skinning="smooth")
    assert skinned.fit.held_out.rms_mm["fitted"] < 0.05 * skinned.fit.held_out.rms_mm["rig"]
