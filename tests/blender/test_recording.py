# SPDX-License-Identifier: GPL-3.0-or-later
"""Recordings of the elbow: they have the mesh that Blender shows, for any pose and object transform."""

import re

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from fdda_addon.core.errors import RecordingError, RigError
from fdda_addon.core.mathematics.poses import ROTATION, Channel, sample_pose
from fdda_addon.core.mathematics.skinning import LinearSkinning
from fdda_addon.core.progress import Progress
from fdda_addon.core.recording.estimate import recording_bytes
from fdda_addon.core.recording.index import read_index
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.core.recording.skinned import skin_recording
from fdda_addon.poses.sampling import sampled_channels
from fdda_addon.recording import plan
from fdda_addon.recording.alone_poses import follows_control_bones
from fdda_addon.recording.plan import RecordingSettings, automatic_poses
from fdda_addon.recording.run import BATCH_POSES, record
from fdda_addon.rig.reading import read_rig
from fdda_addon.scene.armature import Poser
from fdda_addon.scene.mesh import evaluated_positions
from fdda_addon.scene.scene_rig import SceneRig

from .scene_state import drain, fresh_elbow


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


def test_the_rig_is_read_as_arrays(fresh):
    rig = read_rig(fresh)
    assert rig.joint_names == ("upper", "lower") and rig.parents.tolist() == [-1, 0]
    assert rig.skin_joints.shape == rig.skin_weights.shape == (rig.vertex_count, 4)
    np.testing.assert_allclose(rig.skin_weights.sum(axis=1), 1, atol=1e-6)
    for vertex in (0, 150, rig.vertex_count - 1):
        groups = {
            fresh.mesh_object.vertex_groups[g.group].name: g.weight
            for g in fresh.mesh_object.data.vertices[vertex].groups
        }
        found = {
            rig.joint_names[j]: w for j, w in zip(rig.skin_joints[vertex], rig.skin_weights[vertex], strict=True) if w
        }
        assert found == pytest.approx({name: w / sum(groups.values()) for name, w in groups.items() if w})
    bones = fresh.armature_object.data.bones
    np.testing.assert_allclose(rig.rest_matrices[1], np.array(bones["lower"].matrix_local), atol=1e-6)


def test_objects_with_different_transforms(fresh, tmp_path):
    """Pose matrices are in the space of the mesh object, for any transforms of the two objects."""
    fresh.mesh_object.parent = None
    fresh.mesh_object.location, fresh.mesh_object.rotation_euler = (0.3, -0.2, 0.1), (0.2, 0.4, -0.3)
    fresh.armature_object.location, fresh.armature_object.rotation_euler = (-0.5, 0.1, 0.9), (1.0, 0.2, 0)
    fresh.armature_object.scale = (1.5, 1.5, 1.5)
    recording = recorded(fresh, tmp_path / "r", poses=6)
    fresh.armature_object.animation_data_clear()
    assert_reproduces(fresh, recording, (random_pose(fresh, recording, index) for index in (0, 5)))
    to_mesh = fresh.mesh_object.matrix_world.inverted() @ fresh.armature_object.matrix_world
    expected = np.array(to_mesh @ fresh.armature_object.pose.bones["lower"].matrix)
    np.testing.assert_allclose(recording.pose_matrices[5, 1], expected, atol=1e-5)


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
    mesh = fresh.mesh_object.data
    fresh.mesh_object.shape_key_add(name="Basis")
    key = fresh.mesh_object.shape_key_add(name="bump")
    for vertex in mesh.vertices:
        if vertex.co.x > 0.45:
            key.data[vertex.index].co.y += 0.02
    driver = key.driver_add("value").driver
    variable = driver.variables.new()
    variable.type = "TRANSFORMS"
    variable.targets[0].id = fresh.armature_object
    variable.targets[0].bone_target = "upper"
    variable.targets[0].transform_type, variable.targets[0].transform_space = "ROT_Z", "LOCAL_SPACE"
    driver.expression = "var"
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
    first, second, other = (
        recorded(fresh, tmp_path / name, poses=3, seed=seed) for name, seed in (("a", 1), ("b", 1), ("c", 2))
    )
    assert np.array_equal(first.positions, second.positions)
    assert not np.array_equal(first.pose_matrices, other.pose_matrices)


def test_more_poses_begin_with_the_same_ones(fresh, tmp_path):
    few, many = (recorded(fresh, tmp_path / str(count), poses=count) for count in (3, 8))
    assert np.array_equal(few.positions[:3], many.positions[:3])


def test_nothing_to_record(fresh, tmp_path):
    with pytest.raises(RecordingError, match="0 poses and no action; give --poses or --action"):
        recorded(fresh, tmp_path / "r", poses=0)


def test_unknown_action(fresh, tmp_path):
    with pytest.raises(RigError, match="has no action 'run'; its actions: 'elbow_wave'"):
        recorded(fresh, tmp_path / "r", actions=("run",))


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


def test_channels_are_what_is_sampled(fresh, tmp_path):
    recording = recorded(fresh, tmp_path / "r", poses=3)
    assert recording.info.sampling.channels == sampled_channels(fresh, recording.rig)
