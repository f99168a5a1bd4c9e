# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigify's control rigs: poses are sampled on control bones, and the model reads the deforming bones."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import rigify
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.skinned import skin_recording

from .conftest import assert_plays, run, train

ROOT = Path(__file__).resolve().parents[2]
MAX_ERROR_RATIO = 0.1
"""Limit for the model's error, as a ratio of linear skinning's error, on an action outside the training data."""


@dataclass(frozen=True)
class Character:
    """Paths of a character's files."""

    rig: Path
    recording: Path
    model: Path


@pytest.fixture(scope="module", params=["BASIC_HUMAN", pytest.param("HORSE", marks=pytest.mark.slow)])
def character(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Character:
    """Build a Rigify rig in another process, record it and train a model."""
    folder = tmp_path_factory.mktemp(request.param.lower())
    files = Character(folder / "rig.blend", folder / "recording", folder / "model.onnx")
    command = [sys.executable, "-m", rigify.__name__, request.param, files.rig]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL, timeout=300)
    sample = ("--bones-to-pose", f"action:{rigify.REHEARSAL}", "--action", rigify.REHEARSAL)
    assert run("record", files.rig, files.recording, "--poses", 150, *sample) == 0
    train(files.recording, files.model, "--passes", 50)
    return files


def test_only_deforming_bones_are_joints(character: Character):
    recording = read_recording(character.recording)
    names = recording.rig.joint_names
    assert names and all(name.startswith("DEF-") for name in names)
    sampled = {channel.name for channel in recording.info.sampling.channels}
    assert {"torso", "chest", "head"} <= sampled and not sampled & set(names)
    # Every deforming bone but the root has a deforming bone as its parent.
    parents = {
        name: names[joint.parent] for name, joint in zip(names, recording.rig.joints, strict=True) if joint.parent >= 0
    }
    assert len(parents) == len(names) - 1


def test_only_near_joints_influence_a_foot(character: Character):
    """No joint of head or hands influences a foot."""
    recording = read_recording(character.recording)
    names = recording.rig.joint_names
    for partition in skin_recording(recording).partitions:
        influencing_names = {names[joint] for joint in partition.influencing}
        if "foot" in names[partition.joint] and "fore" not in names[partition.joint]:
            assert influencing_names
            assert not any(part in name for name in influencing_names for part in ("head", "neck", "forearm", "hand"))


def test_an_action_outside_the_training_data_has_small_errors(character: Character, tmp_path: Path):
    report = tmp_path / "errors.json"
    action = ("--action", rigify.PERFORMANCE)
    assert run("evaluate", character.rig, character.model, "--json", report, "--poses", 0, *action) == 0
    (errors,) = json.loads(report.read_text())["actions"]
    assert errors["linear"]["mean"] > 1.0
    assert errors["fdda"]["mean"] < MAX_ERROR_RATIO * errors["linear"]["mean"]


def test_the_bound_character_plays_the_action(character: Character, tmp_path: Path):
    bound_path = tmp_path / "bound.blend"
    assert run("bind", character.rig, character.model, bound_path) == 0
    bpy.ops.wm.open_mainfile(filepath=str(bound_path))
    mesh_object, armature_object = bpy.data.objects["body"], bpy.data.objects["rig"]
    armature_object.animation_data.action = bpy.data.actions[rigify.PERFORMANCE]
    shapes = []
    for frame in (1, 30, 61):
        bpy.context.scene.frame_set(frame)
        shapes.append(assert_plays(mesh_object, tmp_path / character.model.name))
    assert np.abs(shapes[0] - shapes[1]).max() > 0.01
