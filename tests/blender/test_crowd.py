# SPDX-License-Identifier: GPL-3.0-or-later
"""Many bound characters in one file: one call for all of a model, several models side by side; and the first frame."""

import json
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest
from conftest import ELBOW, assert_plays, predicted, run

from fdda_addon.runtime import playback
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.runtime.network import Network
from fdda_addon.scene.rig import SceneRig, armature_modifier

ROOT = Path(__file__).resolve().parents[2]
CROWD = 20
COLD_START_SECONDS = 1.0


def crowd_of(first: bpy.types.Object, count: int) -> list[bpy.types.Object]:
    """Copies of a bound object, each with an armature of its own in a pose of its own; the first is the object."""
    crowd = [first]
    for _ in range(count - 1):
        mesh_copy, armature_copy = first.copy(), armature_modifier(first).object.copy()
        for copy in (mesh_copy, armature_copy):
            bpy.context.scene.collection.objects.link(copy)
        armature_modifier(mesh_copy).object = armature_copy
        mesh_copy.parent = armature_copy if first.parent else None
        crowd.append(mesh_copy)
    bpy.context.view_layer.update()
    for number, mesh_object in enumerate(crowd):
        armature_modifier(mesh_object).object.pose.bones["lower"].rotation_euler[0] = 0.1 + 1.2 * number / count
    return crowd


@pytest.fixture
def calls(monkeypatch) -> list[int]:
    """How many poses each call of a network got."""
    counted, real = [], Network.positions

    def positions(network: Network, pose_matrices: np.ndarray, *controls: np.ndarray) -> np.ndarray:
        counted.append(len(pose_matrices))
        return real(network, pose_matrices, *controls)

    monkeypatch.setattr(playback.Network, "positions", positions)
    return counted


def test_a_crowd_is_one_call(bound, elbow, calls):
    crowd = crowd_of(bound, CROWD)
    calls.clear()
    bpy.context.view_layer.update()
    assert calls == [CROWD]
    for mesh_object in crowd:
        assert_plays(mesh_object, elbow.model)
    assert len({predicted(mesh_object, elbow.model).tobytes() for mesh_object in crowd}) == CROWD


def test_only_those_that_moved_are_evaluated(bound, calls):
    crowd = crowd_of(bound, 5)
    bpy.context.view_layer.update()
    calls.clear()
    armature_modifier(crowd[2]).object.pose.bones["lower"].rotation_euler[0] = -0.3
    bpy.context.view_layer.update()
    assert calls == [1]


def test_different_models_side_by_side(bound, elbow, tmp_path, calls):
    other = tmp_path / "other.onnx"
    assert run("train", elbow.recording, other, "--epochs", 3, "--hidden", 8, "--seed", 5) == 0
    bpy.ops.wm.open_mainfile(filepath=str(elbow.bound))
    crowd = crowd_of(bpy.data.objects[ELBOW], 4)
    for mesh_object in crowd[2:]:
        unbind(mesh_object)
        bind(SceneRig(mesh_object, armature_modifier(mesh_object).object), other)
    bpy.context.view_layer.update()
    for number, mesh_object in enumerate(crowd):
        armature_modifier(mesh_object).object.pose.bones["lower"].rotation_euler[0] = -0.2 - 0.1 * number
    calls.clear()
    bpy.context.view_layer.update()
    assert calls == [2, 2]
    for number, mesh_object in enumerate(crowd):
        assert_plays(mesh_object, elbow.model if number < 2 else other)
    assert np.abs(predicted(crowd[0], elbow.model) - predicted(crowd[0], other)).max() > 1e-4


def test_one_that_fails_leaves_the_others_playing(bound, elbow, capsys):
    crowd = crowd_of(bound, 3)
    bpy.context.view_layer.update()
    bpy.data.objects.remove(armature_modifier(crowd[1]).object)
    for mesh_object in (crowd[0], crowd[2]):
        armature_modifier(mesh_object).object.pose.bones["lower"].rotation_euler[0] = 0.4
    bpy.context.view_layer.update()
    assert (crowd[0].fdda.mode, crowd[1].fdda.mode, crowd[2].fdda.mode) == ("FDDA", "RIG", "FDDA")
    for mesh_object in (crowd[0], crowd[2]):
        assert_plays(mesh_object, elbow.model)


@pytest.fixture(scope="module")
def dense(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bound file of the densest arm, briefly trained: its size decides, not its error."""
    import fdda_addon

    folder = tmp_path_factory.mktemp("dense")
    rig, recording, model, bound = (folder / name for name in ("arm.blend", "recording", "arm.onnx", "bound.blend"))
    fdda_addon.register()
    try:
        assert run("build-arm", rig, "--density", 3) == 0
        assert run("record", rig, recording, "--poses", 40) == 0
        assert run("train", recording, model, "--epochs", 2) == 0
        assert run("bind", rig, model, bound) == 0
    finally:
        fdda_addon.unregister()
    return bound


def test_the_first_frame_of_a_dense_mesh_comes_within_a_second(dense):
    command = [sys.executable, str(ROOT / "benchmarks" / "measure.py"), "cold-start", str(dense)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    measured = json.loads(done.stdout.strip().splitlines()[-1])
    assert not measured["onnxruntime_at_start_up"]
    assert measured["is_right"] and measured["seconds"] < COLD_START_SECONDS
