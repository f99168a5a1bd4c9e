# SPDX-License-Identifier: GPL-3.0-or-later
"""Rigify's control rigs: sampled on their control bones, learned from their deforming ones, played by an action."""

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

from .conftest import assert_plays, run, train

ROOT = Path(__file__).resolve().parents[2]
MOST = 0.1
"""Part of linear skinning's error that may be left on an action that training has not seen."""


@dataclass(frozen=True)
class Character:
    """The files of a character."""

    rig: Path
    recording: Path
    model: Path


@pytest.fixture(scope="module", params=["BASIC_HUMAN", pytest.param("HORSE", marks=pytest.mark.slow)])
def character(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Character:
    folder = tmp_path_factory.mktemp(request.param.lower())
    files = Character(folder / "rig.blend", folder / "recording", folder / "model.onnx")
    command = [sys.executable, "-m", rigify.__name__, request.param, files.rig]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL, timeout=300)
    sample = ("--sample", f"action:{rigify.REHEARSAL}", "--action", rigify.REHEARSAL)
    assert run("record", files.rig, files.recording, "--poses", 150, *sample) == 0
    train(files.recording, files.model, "--epochs", 50)
    return files


def test_the_model_sees_deforming_bones_alone(character: Character):
    recording = read_recording(character.recording)
    names = recording.rig.joint_names
    assert names and all(name.startswith("DEF-") for name in names)
    sampled = {channel.name for channel in recording.info.sampling.channels}
    assert {"torso", "chest", "head"} <= sampled and not sampled & set(names)
    # What lies in the place of an original bone is a child of the deforming bone in that place.
    parents = {
        name: names[joint.parent] for name, joint in zip(names, recording.rig.joints, strict=True) if joint.parent >= 0
    }
    assert len(parents) == len(names) - 1


def test_influences_are_near(character: Character):
    """A limb depends on its own joints, not on those of the other end of the body."""
    recording = read_recording(character.recording)
    names = recording.rig.joint_names
    for partition in recording.partitions:
        around = {names[joint] for joint in partition.influencing}
        if "foot" in names[partition.joint] and "fore" not in names[partition.joint]:
            assert around and not any(part in name for name in around for part in ("head", "neck", "forearm", "hand"))


def test_an_action_that_training_has_not_seen(character: Character, tmp_path: Path):
    report = tmp_path / "errors.json"
    action = ("--action", rigify.PERFORMANCE)
    assert run("evaluate", character.rig, character.model, "--json", report, "--poses", 0, *action) == 0
    (errors,) = json.loads(report.read_text())["actions"]
    assert errors["linear"]["mean"] > 1.0
    assert errors["fdda"]["mean"] < MOST * errors["linear"]["mean"]


def test_the_bound_character_plays_the_action(character: Character, tmp_path: Path):
    bound = tmp_path / "bound.blend"
    assert run("bind", character.rig, character.model, bound) == 0
    bpy.ops.wm.open_mainfile(filepath=str(bound))
    mesh_object, armature_object = bpy.data.objects["body"], bpy.data.objects["rig"]
    armature_object.animation_data.action = bpy.data.actions[rigify.PERFORMANCE]
    seen = []
    for frame in (1, 30, 61):
        bpy.context.scene.frame_set(frame)
        seen.append(assert_plays(mesh_object, tmp_path / character.model.name))
    assert np.abs(seen[0] - seen[1]).max() > 0.01
