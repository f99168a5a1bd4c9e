# SPDX-License-Identifier: GPL-3.0-or-later
"""Many bound characters in one file: characters with the same model are evaluated in one network call."""

import json
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest

from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.runtime.session import session
from fdda_addon.scene.scene_rig import SceneRig, armature_modifier

from ..conftest import ELBOW, assert_plays, evaluated_positions, predicted_positions, run, train
from ..playback import animate, count_calls, crowd_of

ROOT = Path(__file__).resolve().parents[3]
CROWD = 20
COLD_START_PROCESSOR_SECONDS = 0.5
"""About 0.17 on an idle machine. The time on the clock depends on what else the machine does."""


@pytest.fixture
def calls(monkeypatch) -> list[int]:
    """The number of poses of each network call."""
    return count_calls(monkeypatch)


def test_one_frame_of_a_crowd_is_one_network_call(bound_elbow, elbow_files, calls):
    crowd = crowd_of(bound_elbow, CROWD)
    animate(crowd)
    for frame in (1, 2, 3):
        bpy.context.scene.frame_set(frame)
    calls.clear()
    for frame in (4, 9):
        bpy.context.scene.frame_set(frame)
        for mesh_object in crowd:
            assert_plays(mesh_object, elbow_files.model)
    assert calls.count(CROWD) == 2 and calls.count(1) == len(calls) - 2 == 2 * CROWD, "predicted() makes a call too"
    assert len({predicted_positions(mesh_object, elbow_files.model).tobytes() for mesh_object in crowd}) == CROWD


def test_posing_one_character_of_a_crowd_is_one_network_call(bound_elbow, elbow_files, calls):
    crowd = crowd_of(bound_elbow, CROWD)
    animate(crowd)
    for frame in (1, 2, 3):
        bpy.context.scene.frame_set(frame)
    positions_before = {mesh_object: assert_plays(mesh_object, elbow_files.model) for mesh_object in crowd}
    for angle in (0.2, 0.4):
        calls.clear()
        armature_modifier(crowd[7]).object.pose.bones["lower"].rotation_euler[0] = angle
        bpy.context.view_layer.update()
        assert calls == [1]
        moved = assert_plays(crowd[7], elbow_files.model)
        assert np.abs(moved - positions_before[crowd[7]]).max() > 1e-3
        for mesh_object in crowd[:7] + crowd[8:]:
            assert np.array_equal(assert_plays(mesh_object, elbow_files.model), positions_before[mesh_object])
    for frame in (3, 4, 5):
        bpy.context.scene.frame_set(frame)
        for mesh_object in crowd:
            assert_plays(mesh_object, elbow_files.model)


def test_posing_two_characters_of_a_crowd_keeps_the_positions_of_the_others(bound_elbow, elbow_files, calls):
    crowd = crowd_of(bound_elbow, 6)
    animate(crowd)
    crowd[1].fdda.strength, crowd[4].fdda.strength = 0.5, 0.0
    for frame in (1, 2, 3):
        bpy.context.scene.frame_set(frame)
    positions_before = [evaluated_positions(mesh_object) for mesh_object in crowd]
    calls.clear()
    for index in (0, 3):
        armature_modifier(crowd[index]).object.pose.bones["lower"].rotation_euler[0] = -0.3
    bpy.context.view_layer.update()
    assert calls == [6]
    for index, mesh_object in enumerate(crowd):
        assert np.array_equal(evaluated_positions(mesh_object), positions_before[index]) is (index not in (0, 3))
        if mesh_object.fdda.strength == 1:
            assert_plays(mesh_object, elbow_files.model)


def test_crowds_play_with_one_driver_while_frames_change(bound_elbow):
    crowd = crowd_of(bound_elbow, 5)
    animate(crowd)
    bpy.context.view_layer.update()
    count = len(bpy.data.objects)
    for frame in range(1, 13, 3):
        for later in range(3):
            bpy.context.scene.frame_set(frame + later)
        assert [len(batch.groups) for batch in session.batches.values()] == [5]
        armature_modifier(crowd[2]).object.pose.bones["lower"].rotation_euler[0] += 0.1
        bpy.context.view_layer.update()
        assert [len(batch.groups) for batch in session.batches.values()] == [1] * 5
        assert len(bpy.data.objects) == count


def test_the_others_play_on_when_one_character_leaves_a_crowd(bound_elbow, elbow_files):
    """One character is deleted, fails, is disabled, is duplicated or gets another strength."""
    crowd = crowd_of(bound_elbow, 12)
    animate(crowd)
    scene = bpy.context.scene
    for frame in (1, 2, 3):
        scene.frame_set(frame)
    bpy.data.objects.remove(crowd.pop())
    scene.frame_set(4)
    bpy.data.objects.remove(armature_modifier(crowd[-1]).object)
    scene.frame_set(5)
    assert "has no Armature modifier with an armature any more" in crowd.pop().fdda.status
    scene.frame_set(6)
    crowd.pop().fdda.mode = "RIG"
    scene.frame_set(7)
    crowd.pop().fdda.strength = 0.5
    scene.frame_set(8)
    copy = crowd[0].copy()
    scene.collection.objects.link(copy)
    for frame in (9, 10, 11, 12):
        scene.frame_set(frame)
        for mesh_object in (*crowd, copy):
            assert_plays(mesh_object, elbow_files.model)


def test_different_models_side_by_side(bound_elbow, elbow_files, tmp_path, calls):
    other = tmp_path / "other.onnx"
    train(elbow_files.recording, other, "--passes", 3, "--hidden", 8, "--seed", 5)
    bpy.ops.wm.open_mainfile(filepath=str(elbow_files.bound))
    crowd = crowd_of(bpy.data.objects[ELBOW], 4)
    for mesh_object in crowd[2:]:
        unbind(mesh_object)
        bind(SceneRig(mesh_object, armature_modifier(mesh_object).object), other)
    bpy.context.view_layer.update()
    for number, mesh_object in enumerate(crowd):
        armature_modifier(mesh_object).object.pose.bones["lower"].rotation_euler[0] = -0.2 - 0.1 * number
    calls.clear()
    bpy.context.view_layer.update()
    assert calls == [1] * 4
    for number, mesh_object in enumerate(crowd):
        assert_plays(mesh_object, elbow_files.model if number < 2 else other)
    assert np.abs(predicted_positions(crowd[0], elbow_files.model) - predicted_positions(crowd[0], other)).max() > 1e-4


@pytest.fixture(scope="module")
def dense(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bound file of the densest arm. The training is short, because only the number of vertices matters."""
    import fdda_addon

    folder = tmp_path_factory.mktemp("dense")
    rig, recording, model, bound_path = (
        folder / name for name in ("arm.blend", "recording", "arm.onnx", "bound.blend")
    )
    fdda_addon.register()
    try:
        assert run("build-arm", rig, "--density", 3) == 0
        assert run("record", rig, recording, "--poses", 40) == 0
        train(recording, model, "--passes", 2)
        assert run("bind", rig, model, bound_path) == 0
    finally:
        fdda_addon.unregister()
    return bound_path


@pytest.mark.slow
def test_the_first_frame_of_a_dense_mesh_takes_less_than_half_a_second_of_the_processor(dense):
    command = [sys.executable, str(ROOT / "benchmarks" / "measure.py"), "cold-start", str(dense)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    measured = json.loads(done.stdout.strip().splitlines()[-1])
    assert not measured["onnxruntime_at_start_up"]
    assert measured["is_right"] and measured["processor_seconds"] < COLD_START_PROCESSOR_SECONDS


def test_a_crowd_without_one_of_its_joints_shows_the_rig(bound_elbow, calls):
    """The armature objects share one data-block, so renaming a bone affects all characters."""
    crowd = crowd_of(bound_elbow, 4)
    animate(crowd)
    for frame in range(1, 5):
        bpy.context.scene.frame_set(frame)
    assert calls[-1] == 4
    armature_modifier(bound_elbow).object.data.bones["lower"].name = "elsewhere"
    bpy.context.scene.frame_set(5)
    for mesh_object in crowd:
        assert mesh_object.fdda.mode == "RIG" and "lacks the joint 'lower'" in mesh_object.fdda.status
