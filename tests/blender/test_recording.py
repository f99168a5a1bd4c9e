# SPDX-License-Identifier: GPL-3.0-or-later
"""Recordings have the mesh that Blender shows, for any pose and object transform, and the influences of each input."""

import re
from collections.abc import Callable
from math import radians
from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from blend_fixtures.characters import meshes
from blend_fixtures.characters.base import add_key, drive, tube
from blend_fixtures.characters.bones import (
    NewBone,
    add_bone_collection,
    add_bones,
    add_delta_mush,
    limit,
    remove_constraints,
)
from blend_fixtures.characters.training import SMALL
from fdda_addon.core.errors import RecordingError, RigError
from fdda_addon.core.mathematics.metrics import distances
from fdda_addon.core.mathematics.poses import ROTATION, Channel, sample_pose
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.progress import Progress
from fdda_addon.core.recording.estimate import recording_bytes
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.core.recording.skinned import skin_recording
from fdda_addon.jobs import job
from fdda_addon.recording import plan
from fdda_addon.recording.alone_poses import follows_control_bones
from fdda_addon.recording.plan import RecordingSettings, automatic_poses
from fdda_addon.recording.run import BATCH_POSES, record
from fdda_addon.rig.reading import PoseEvaluator, read_model_rig, read_rig
from fdda_addon.runtime.network import Network
from fdda_addon.scene.armature import Poser
from fdda_addon.scene.mesh import evaluated_positions
from fdda_addon.scene.scene_rig import SceneRig, find_rig

from .conftest import train
from .scene_state import assert_same_state, drain, fresh_elbow, scene_state


@pytest.fixture
def fresh() -> SceneRig:
    return fresh_elbow()


def recorded(rig: SceneRig, path, **settings) -> Recording:
    drain(record(rig, path, RecordingSettings(**settings)))
    return read_recording(path)


def shown(rig: SceneRig) -> np.ndarray:
    """(V, 3) what Blender shows now, mesh-object space."""
    return evaluated_positions(rig.mesh_object, bpy.context.evaluated_depsgraph_get())


def assert_reproduces(rig: SceneRig, recording: Recording, poses) -> None:
    """Assert that recorded positions are those that Blender shows in the same poses."""
    for index, set_pose in poses:
        set_pose()
        assert np.abs(shown(rig) - recording.positions[index]).max() < 1e-6


def influencing_joints(recording: Recording) -> list[tuple[int, tuple[int, ...]]]:
    """Return each main joint with the joints that influence its partition."""
    return [(p.joint, p.influencing) for p in skin_recording(recording).partitions]


def random_pose(rig: SceneRig, recording: Recording, index: int):
    channels = recording.info.sampling.channels
    values = sample_pose(channels, recording.info.sampling.seed, index)
    return index, lambda: Poser(rig, channels).set(values)


def test_positions_are_those_that_blender_shows(fresh, tmp_path):
    recording = recorded(fresh, tmp_path / "r", poses=12, seed=3)
    fresh.armature_object.animation_data_clear()
    assert_reproduces(fresh, recording, (random_pose(fresh, recording, index) for index in (0, 5, 11)))
    linear = LinearSkinning(recording.rig).positions(np.array(recording.pose_matrices))
    assert np.abs(recording.positions - linear).max() > 2e-3, "the rig differs from its linear skinning"
    assert len({pose.tobytes() for pose in recording.pose_matrices[:12]}) == 12


def test_influences_of_the_elbow(fresh, tmp_path):
    """The bend of the lower bone affects the upper half, and the rotation of the upper bone affects no residual."""
    recording = recorded(fresh, tmp_path / "r", poses=3)
    assert influencing_joints(recording) == [(0, (1,)), (1, (1,))]


def test_a_driven_joint_is_found_by_a_name_with_quotes(fresh):
    armature_object, name = fresh.armature_object, 'lo"wer'
    armature_object.data.bones["lower"].name = name
    channels = (Channel("upper", ROTATION, 0, -1.0, 1.0),)
    assert not follows_control_bones(fresh, read_rig(fresh), channels)
    armature_object.pose.bones[name].driver_add("location", 0)
    assert follows_control_bones(fresh, read_rig(fresh), channels)


def test_rounding_far_from_the_origin_is_no_influence(fresh, tmp_path):
    away = Matrix.Translation((1000, 0, 0))
    fresh.mesh_object.data.transform(away)
    fresh.armature_object.data.transform(away)
    recording = recorded(fresh, tmp_path / "r", poses=3)
    assert influencing_joints(recording) == [(0, (1,)), (1, (1,))]


def test_influences_include_distant_vertices(fresh, tmp_path):
    """The upper bone drives a shape key of the lower half, whose value influences the lower half only."""
    key = add_key(fresh.mesh_object, "bump", lambda points: points + np.outer(points[:, 0] > 0.45, (0, 0.02, 0)))
    drive(key, "value", fresh.armature_object, ("upper", "ROT_Z"))
    recording = recorded(fresh, tmp_path / "r", poses=3)
    partitions = skin_recording(recording).partitions
    assert [(p.joint, p.influencing, p.controls) for p in partitions] == [(0, (1,), ()), (1, (1,), (0,))]


def test_an_action_is_recorded_frame_by_frame(fresh, tmp_path):
    recording = recorded(fresh, tmp_path / "r", poses=4, actions=("elbow_wave",))
    assert [(s.kind, s.poses, s.name, s.frames) for s in recording.info.sampling.sources] == [
        ("random", 4, "", (0, 0)),
        ("action", 30, "elbow_wave", (1, 1)),
        ("alone", 12, "", (0, 0)),
    ]
    frames = ((4 + frame - 1, lambda frame=frame: bpy.context.scene.frame_set(frame)) for frame in (1, 10, 23, 30))
    assert_reproduces(fresh, recording, frames)


def test_an_action_alone(fresh, tmp_path):
    """Joints are moved alone to their transforms in the action. The upper joint changes no residual."""
    recording = recorded(fresh, tmp_path / "r", poses=0, actions=("elbow_wave",))
    assert len(recording.pose_matrices) == 30 + 12
    assert influencing_joints(recording) == [(0, (1,)), (1, (1,))]


def test_an_action_that_moves_the_object_restores_its_transform(fresh, tmp_path):
    rig = fresh.armature_object
    action = rig.animation_data.action = bpy.data.actions.new("walk")
    rig["mood"] = rig.pose.bones["lower"]['a "b"'] = 0.0
    for frame in (1, 5):
        rig.location[0] = rig["mood"] = rig.pose.bones["lower"]['a "b"'] = float(frame)
        rig.keyframe_insert("location", frame=frame)
        rig.keyframe_insert('["mood"]', frame=frame)
        rig.keyframe_insert('pose.bones["lower"]["a \\"b\\""]', frame=frame)
    rig.animation_data.action = bpy.data.actions["elbow_wave"]
    rig.location, rig["mood"], rig.pose.bones["lower"]['a "b"'] = (7, 8, 9), 55.0, 3.0
    recorded(fresh, tmp_path / "r", poses=0, actions=("walk",))
    assert rig.location[:] == (7, 8, 9) and rig["mood"] == 55 and rig.pose.bones["lower"]['a "b"'] == 3
    assert action.name == "walk" and rig.animation_data.action.name == "elbow_wave"


def test_progress(fresh, tmp_path, monkeypatch):
    poses, checked_sizes = BATCH_POSES + 5, []
    monkeypatch.setattr("fdda_addon.recording.run.check_disk_space", lambda _, size: checked_sizes.append(size))
    steps = list(record(fresh, tmp_path / "r", RecordingSettings(poses=poses, influence_poses=4)))
    # There are 4 base poses, and from each, one pose for each of the 2 joints.
    first, *others = steps
    assert (first.stage, first.done, first.total) == ("poses", 0, poses)
    assert re.fullmatch(
        r"255 poses, and 12 to find what each bone and input moves, each of 300 vertices: about 1 MB on the disk, "
        r"about (a|\d+) seconds?",
        first.note,
    )
    assert others == [
        Progress(stage, done, total)
        for stage, total in (("poses", poses), ("influences", 12))
        for done in range(1, total + 1)
    ]
    assert checked_sizes == [recording_bytes(read_recording(tmp_path / "r").rig, poses + 12)]


@pytest.mark.parametrize(("source", "actions"), [("channels", ()), ("overrides", ("elbow_wave",))])
@pytest.mark.parametrize("closed_after", [7, 20, 26])
def test_a_recording_that_is_closed_keeps_its_poses(fresh, tmp_path, closed_after, source, actions):
    """The poses that move one input alone resume like all others, whether by channels or by transforms of joints."""
    if source == "overrides":
        fresh.armature_object.pose.bones["lower"].constraints.new("COPY_ROTATION").target = fresh.armature_object
        fresh.armature_object.pose.bones["lower"].constraints[-1].subtarget = "upper"
    options = {"poses": 20 if source == "channels" else 5, "seed": 5, "actions": actions}
    recorded(fresh, tmp_path / "whole", **options)
    steps = record(fresh, tmp_path / "r", RecordingSettings(**options))
    pose_count = 0
    while pose_count < closed_after:
        pose_count += next(steps).done > 0
    steps.close()
    assert read_index(tmp_path / "r")["complete"] == closed_after
    recorded(fresh, tmp_path / "r", **options, resume=True)
    assert {path.name: path.read_bytes() for path in (tmp_path / "r").iterdir()} == {
        path.name: path.read_bytes() for path in (tmp_path / "whole").iterdir()
    }


@pytest.mark.parametrize(
    ("milliseconds", "bytes_per_pose", "free_bytes", "poses"),
    [
        (40, 1e5, 1e12, 1500),
        (1, 1e5, 1e12, 5000),
        (500, 1e5, 1e12, 1000),
        # 150,000 vertices, and a nearly full disk.
        (12.1, 1.8e6, 1e12, 2000),
        (1, 1e5, 5e8, 2500),
        (1, 1e7, 1e6, 1000),
    ],
)
def test_the_automatic_number_of_poses_is_bounded(milliseconds, bytes_per_pose, free_bytes, poses):
    assert automatic_poses(milliseconds / 1000, bytes_per_pose, free_bytes) == poses


def test_a_resumed_recording_keeps_its_automatic_number_of_poses(fresh, tmp_path, monkeypatch):
    """The number depends on the machine and its load, so the recording has it."""
    monkeypatch.setattr(plan, "AUTO_SECONDS", 1e-9)
    steps = record(fresh, tmp_path / "r", RecordingSettings(auto_poses=True))
    notes = [next(steps).note for _ in range(12)]
    steps.close()
    assert sum(note.startswith("1,000 random poses, at ") for note in notes) == 1
    monkeypatch.setattr(plan, "AUTO_SECONDS", 1e9)
    recording = recorded(fresh, tmp_path / "r", auto_poses=True, resume=True)
    whole = recorded(fresh, tmp_path / "whole", poses=1000)
    assert recording.info.sampling == whole.info.sampling
    assert np.array_equal(recording.positions, whole.positions)


def test_the_seed_determines_the_poses(fresh, tmp_path):
    """A longer recording begins with the same poses."""
    first, longer, other = (
        recorded(fresh, tmp_path / name, poses=poses, seed=seed)
        for name, poses, seed in (("a", 3, 1), ("b", 5, 1), ("c", 3, 2))
    )
    assert np.array_equal(first.positions[:3], longer.positions[:3])
    assert not np.array_equal(first.pose_matrices[:3], other.pose_matrices[:3])


def test_nothing_to_record(fresh, tmp_path):
    with pytest.raises(RecordingError, match="0 poses and no action; give --poses or --action"):
        recorded(fresh, tmp_path / "r", poses=0)


def test_a_joint_scaled_to_nothing_is_named(fresh, tmp_path):
    """Blender cannot divide by it either; the recording says so in place of writing infinity."""
    bone = fresh.armature_object.pose.bones["lower"]
    limit = bone.constraints.new("LIMIT_SCALE")
    limit.use_max_x = limit.use_max_y = limit.use_max_z = True
    limit.owner_space = "LOCAL"
    with pytest.raises(RecordingError, match="The bone 'lower' has a scale of zero in pose 0; look for the key"):
        recorded(fresh, tmp_path / "r", poses=3)
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize("name", ["elbow", "elbow_rig"])
def test_an_object_scaled_to_nothing_is_named(fresh, tmp_path, name):
    bpy.data.objects[name].scale[1] = 0
    bpy.context.view_layer.update()
    with pytest.raises(RigError, match=r"'elbow(_rig)?' has a scale of zero; give it another"):
        recorded(fresh, tmp_path / "r", poses=3)


def chains_with_distant_influences() -> None:
    """Let the first bone of each chain drive a shape key of the next chain."""
    meshes.five_hundred_bones()
    mesh_object, armature_object = bpy.data.objects["creature"], bpy.data.objects["creature_rig"]
    points = np.array([vertex.co for vertex in mesh_object.data.vertices])
    for chain in range(meshes.CHAINS):
        offsets = np.outer(np.abs(points[:, 1] - chain * 0.05) < 0.02, (0.0, 0.0, 0.05))
        key = add_key(mesh_object, f"key {chain}", offsets.__add__)
        key.slider_min = -1.0
        path = f'pose.bones["finger.{(chain - 1) % meshes.CHAINS:02}.00"].rotation_euler[0]'
        drive(key, "value", armature_object, path)


def chains_on_controls() -> None:
    """Let control bones move all chains: the poses come from IK, a copied rotation and a control of all of them."""
    meshes.five_hundred_bones()
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
    [
        (meshes.five_hundred_bones, ()),
        (chains_with_distant_influences, ()),
        (chains_on_controls, ("collection:Controls",)),
    ],
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


def recorded_folder(tmp_path: Path) -> Path:
    return tmp_path / "elbow_recording"


def press_record(rig: SceneRig, poses: int = 20, **options) -> set[str]:
    rig.mesh_object.fdda.settings.poses = poses
    return bpy.ops.fdda.record(**options)


def test_a_recording_follows_the_settings_and_is_stored_beside_the_file(saved, tmp_path):
    settings = saved.mesh_object.fdda.settings
    settings.seed, settings.spread = 5, 0.75
    bpy.data.actions["elbow_wave"].fdda.record = True
    bpy.data.actions.new("of something else").fdda.record = True
    before = scene_state(saved)
    assert press_record(saved) == {"FINISHED"}
    assert_same_state(before, scene_state(saved))
    sampling = read_recording(recorded_folder(tmp_path)).info.sampling
    assert (sampling.seed, sampling.spread) == (5, 0.75)
    assert [(s.kind, s.poses, s.name) for s in sampling.sources] == [
        ("random", 20, "remix"),
        ("action", 30, "elbow_wave"),
        ("alone", 12, ""),
    ]
    assert (
        job.state_of("record").outcome
        == "Recorded 50 poses, and 12 to find what each bone and input moves, into 'elbow_recording'."
    )


def test_an_unsaved_file_is_refused_without_a_folder():
    bpy.ops.fdda.add_sample_arm(density="1")
    with pytest.raises(
        RuntimeError, match=r"Save the \.blend file first \(recordings are stored next to it\), or choose a Folder"
    ):
        bpy.ops.fdda.record()


def test_a_recording_is_stored_in_the_given_folder(saved, tmp_path):
    saved.mesh_object.fdda.settings.recording = "//deep/down"
    assert press_record(saved) == {"FINISHED"}
    assert read_index(tmp_path / "deep" / "down")["complete"] == 32
    assert press_record(saved, folder=str(tmp_path / "other")) == {"FINISHED"}
    assert read_index(tmp_path / "other")["complete"] == 32


def test_a_canceled_recording_keeps_its_poses_and_is_resumed(saved, tmp_path, monkeypatch):
    show = job.JobState.show

    def cancel(state, progress):
        show(state, progress)
        if progress.stage == "poses" and progress.done == 8:
            bpy.ops.fdda.cancel()

    before = scene_state(saved)
    with monkeypatch.context() as patch:
        patch.setattr(job.JobState, "show", cancel)
        assert press_record(saved) == {"CANCELLED"}
    assert_same_state(before, scene_state(saved))
    outcome = job.state_of("record").outcome
    complete = read_index(recorded_folder(tmp_path))["complete"]
    assert complete >= 8 and f"{complete} of 20 poses are kept" in outcome
    with pytest.raises(RuntimeError, match="holds a recording already"):
        press_record(saved)
    assert press_record(saved, resume=True) == {"FINISHED"}
    assert len(read_recording(recorded_folder(tmp_path)).positions) == 32


def test_deleting_a_recording_keeps_other_files(saved, tmp_path):
    with pytest.raises(RuntimeError, match="holds no recording; there is nothing to remove"):
        bpy.ops.fdda.delete_recording()
    press_record(saved)
    (recorded_folder(tmp_path) / "notes.txt").write_text("mine")
    assert bpy.ops.fdda.delete_recording() == {"FINISHED"}
    assert [path.name for path in recorded_folder(tmp_path).iterdir()] == ["notes.txt"]


def test_a_bound_character_is_recorded_with_its_rig(bound_elbow, elbow_files, tmp_path):
    bpy.context.view_layer.objects.active = bound_elbow
    assert bound_elbow.fdda.is_playing
    bound_elbow.fdda.settings.poses = 5
    assert bpy.ops.fdda.record(folder=str(tmp_path / "r")) == {"FINISHED"}
    first, again = (read_recording(path).positions[:5] for path in (elbow_files.recording, tmp_path / "r"))
    np.testing.assert_allclose(again, first, atol=1e-6)
    assert bound_elbow.fdda.is_playing
