# SPDX-License-Identifier: GPL-3.0-or-later
"""Recordings of a target: another object whose surface is learned in place of the rig's own."""

import json
from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import targets
from blend_fixtures.elbow import ACTION, FRAMES
from fdda_addon.core.recording.reader import Recording, read_recording
from fdda_addon.core.recording.skinned import skin_recording
from fdda_addon.core.rig import STATIC_JOINT
from fdda_addon.scene.blend_file import save_copy

from ..conftest import run, train

EXACT = 1e-5
"""Tolerance for surfaces that are read from files, relative to the size of the character."""


def built(build, path: Path) -> Path:
    """Build a character, and save it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build()
    save_copy(path)
    return path


def recorded(rig: Path, path: Path, *options: object) -> Recording:
    assert run("record", rig, path, "--object", "elbow", *options) == 0
    return read_recording(path)


def of_flesh(rig: Path, path: Path, *options: object) -> Recording:
    return recorded(rig, path, "--learn-from", "flesh", "--action", ACTION, *options)


def residuals(recording: Recording) -> np.ndarray:
    skinned = skin_recording(recording)
    return skinned.compute_residuals(np.arange(len(skinned.rows)))


@pytest.fixture(scope="module")
def own(tmp_path_factory) -> Recording:
    """A recording of the copy as a separate rig, with its action."""
    import fdda_addon

    fdda_addon.register()
    folder = tmp_path_factory.mktemp("own")
    rig = built(targets.target_copy, folder / "rig.blend")
    assert run("record", rig, folder / "own", "--object", "flesh", "--poses", 0, "--action", ACTION) == 0
    return read_recording(folder / "own")


FILES = (targets.target_alembic, targets.target_usd, targets.target_pc2, targets.target_mdd)


@pytest.mark.parametrize("build", [targets.target_copy, *FILES])
def test_a_target_has_the_recording_of_the_rig_that_it_copies(build, own, tmp_path):
    rig = built(build, tmp_path / "rig.blend")
    recording = of_flesh(rig, tmp_path / "recording", *(["--poses", 0] if build is targets.target_copy else []))
    assert recording.info.sampling.sources[0].poses == FRAMES
    # In addition to the bones there is a static joint, from which a target can derive the direction of gravity.
    names = ["upper", "lower"] if build is targets.target_copy else ["upper", "lower", STATIC_JOINT]
    assert list(recording.rig.joint_names) == names
    assert np.array_equal(recording.pose_matrices[:FRAMES, :2], own.pose_matrices[:FRAMES])
    apart = np.abs(recording.positions[:FRAMES] - own.positions[:FRAMES]).max()
    assert apart <= EXACT * own.rig.size
    target = json.loads((tmp_path / "recording" / "recording.json").read_text())["target"]
    follows = "pose" if build is targets.target_copy else "frames"
    assert target == {"object": "flesh", "follows": follows, "pre_roll": 0}


def test_a_copy_is_recorded_in_random_poses_and_its_influences_are_found(tmp_path):
    rig = built(targets.target_copy, tmp_path / "rig.blend")
    recording = recorded(rig, tmp_path / "recording", "--learn-from", "flesh", "--poses", 20)
    assert (tmp_path / "own").exists() is False
    assert run("record", rig, tmp_path / "own", "--object", "flesh", "--poses", 20) == 0
    own = read_recording(tmp_path / "own")
    assert np.array_equal(recording.positions, own.positions)
    partitions, own_partitions = (skin_recording(r).partitions for r in (recording, own))
    assert [p.influencing for p in partitions] == [p.influencing for p in own_partitions]


def test_sculpted_shapes_are_recorded(tmp_path):
    recording = of_flesh(built(targets.target_shape_keys, tmp_path / "rig.blend"), tmp_path / "recording")
    lengths = np.linalg.norm(residuals(recording), axis=2)
    bent = recording.pose_matrices[:, 1] - recording.pose_matrices[:1, 1]
    assert lengths[np.abs(bent).max(axis=(1, 2)).argmax()].max() > 0.005
    assert lengths[0].max() < 1e-5


def test_a_target_with_another_transform_is_recorded_in_the_space_of_the_mesh(own, tmp_path):
    def build() -> None:
        targets.target_alembic()
        mesh = bpy.data.objects["elbow"]
        mesh.parent = None
        mesh.scale = (0.5, 0.5, 0.5)
        mesh.data.transform(((2, 0, 0, 0), (0, 2, 0, 0), (0, 0, 2, 0), (0, 0, 0, 1)))

    recording = of_flesh(built(build, tmp_path / "rig.blend"), tmp_path / "recording")
    apart = np.abs(recording.positions[:FRAMES] - 2 * own.positions[:FRAMES]).max()
    assert apart <= 2 * EXACT * own.rig.size


def test_a_model_of_a_cache_is_bound_evaluated_and_plays_without_it(tmp_path, capfd):
    rig = built(targets.target_alembic, tmp_path / "rig.blend")
    of_flesh(rig, tmp_path / "recording")
    model, bound_path = tmp_path / "elbow.onnx", tmp_path / "bound.blend"
    train(tmp_path / "recording", model, "--passes", 60)
    errors = tmp_path / "errors.json"
    options = ["--object", "elbow", "--learn-from", "flesh", "--poses", 0, "--action", ACTION, "--json", errors]
    assert run("evaluate", rig, model, *options) == 0
    found = json.loads(errors.read_text())
    assert found["poses"] == FRAMES
    assert found["fdda"]["mean"] < 0.3 * found["linear"]["mean"]
    assert "stands still" not in capfd.readouterr().out
    bpy.ops.wm.open_mainfile(filepath=str(rig))
    bpy.data.cache_files[0].frame_offset = 5
    save_copy(tmp_path / "short.blend")
    assert run("evaluate", tmp_path / "short.blend", model, *options, "--overwrite") == 0
    assert "The target stands still in 5 poses in which the rig moves, and these count as" in capfd.readouterr().out
    assert (found["frozen"], json.loads(errors.read_text())["frozen"]) == (0, 5)
    assert run("record", rig, tmp_path / "recording", "--object", "elbow", "--refine", model) == 1
    assert "is of the target 'flesh', and poses are added of rigs alone" in capfd.readouterr().err
    assert run("bind", rig, model, bound_path, "--object", "elbow") == 0
    bpy.ops.wm.open_mainfile(filepath=str(bound_path))
    from ..conftest import assert_plays

    bpy.data.objects.remove(bpy.data.objects["flesh"])
    bpy.context.scene.frame_set(20)
    assert_plays(bpy.data.objects["elbow"], model)


def test_the_sidebar_records_and_evaluates_a_target(own, tmp_path, capfd):
    built(targets.target_pc2, tmp_path / "rig.blend")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "rig.blend"))
    mesh_object = bpy.data.objects["elbow"]
    bpy.context.view_layer.objects.active = mesh_object
    settings = mesh_object.fdda.settings
    settings.learn_from, settings.poses, settings.settle_frames = "flesh", 0, 0
    bpy.data.actions[ACTION].fdda.record = True
    assert bpy.ops.fdda.record() == {"FINISHED"}
    recording = read_recording(tmp_path / "rig_elbow_recording")
    assert np.abs(recording.positions[:FRAMES] - own.positions[:FRAMES]).max() <= EXACT * own.rig.size
    assert recording.info.target.object_name == "flesh"
    settings.poses = 3
    with pytest.raises(RuntimeError, match="The target 'flesh' follows frames"):
        bpy.ops.fdda.record(folder=str(tmp_path / "random"))
    model = tmp_path / "elbow.onnx"
    train(recording.path, model, "--passes", 30)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "rig.blend"))
    from fdda_addon.evaluation import last_evaluation
    from fdda_addon.runtime.binding import bind
    from fdda_addon.scene.scene_rig import find_rig

    mesh_object = bpy.data.objects["elbow"]
    mesh_object.fdda.settings.learn_from = "flesh"
    bind(find_rig("elbow"), model)
    bpy.context.view_layer.objects.active = mesh_object
    assert bpy.ops.fdda.evaluate(source="ACTION", action=ACTION) == {"FINISHED"}
    linear = last_evaluation.get(mesh_object).total["linear"]
    assert linear.mean > 0.5  # The rig itself is its linear skinning.
    bpy.data.objects["flesh"].modifiers["Cache"].frame_start += 5
    capfd.readouterr()
    assert bpy.ops.fdda.evaluate(source="ACTION", action=ACTION) == {"FINISHED"}
    assert "The target stands still in 5 poses in which the rig moves" in capfd.readouterr().out
