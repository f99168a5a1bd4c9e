# SPDX-License-Identifier: GPL-3.0-or-later
"""The frame profile: the parts of a frame, what a fast rig would save, and the restored scene."""

import errno
import json
import os
import tempfile
from dataclasses import replace
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from blend_fixtures.characters.base import BEND, add_key, drive
from blend_fixtures.characters.bones import NewBone, add_bones
from fdda_addon.core.errors import TRY_AGAIN
from fdda_addon.core.progress import run_job
from fdda_addon.jobs import job
from fdda_addon.panels.frame_profile import draw_profile
from fdda_addon.scene import blend_file
from fdda_addon.scene.scene_rig import SceneRig
from fdda_addon.timing import measurements
from fdda_addon.timing.durations import TEMPORARY_SCENE_NAME, Duration
from fdda_addon.timing.frame_profile import (
    BONES,
    DRAWING,
    KEY_DRIVERS,
    MODIFIER,
    REST,
    SHAPE_KEYS,
    FramePart,
    FrameProfile,
    profile_frame,
)

from .conftest import ELBOW_RIG, run
from .drawing import Layout
from .scene_state import assert_same_state, scene_state


@pytest.fixture
def slow_rig(saved: SceneRig) -> SceneRig:
    """The elbow with a slow modifier, and one bone whose constraints take nearly all time of the bones."""
    armature_object = saved.armature_object
    add_bones(armature_object, *(NewBone(f"extra.{n}", (0, 0.3, 0), (0, 0.3, 0.05), "upper", False) for n in range(12)))
    for index in range(12):
        for _ in range(400 if index == 7 else 1):
            constraint = armature_object.pose.bones[f"extra.{index}"].constraints.new("COPY_ROTATION")
            constraint.target, constraint.subtarget = armature_object, "lower"
    armature_object.pose.bones["extra.2"].constraints[0].mute = True
    saved.mesh_object.modifiers["CorrectiveSmooth"].iterations = 1000
    bpy.context.view_layer.objects.active = saved.mesh_object
    bpy.context.view_layer.update()
    return saved


def hide_extra_bones(rig: SceneRig) -> None:
    """Hide the bones with constraints, in a bone collection."""
    armature = rig.armature_object.data
    collection = armature.collections.new("extra")
    for bone in armature.bones:
        if bone.name.startswith("extra."):
            collection.assign(bone)
    collection.is_visible = False


def profile_of(rig: SceneRig) -> FrameProfile:
    return run_job(profile_frame(rig.armature_object))


def test_the_parts_add_up_to_the_frame_and_the_slow_modifier_is_the_largest(slow_rig):
    before = scene_state(slow_rig)
    profile = profile_of(slow_rig)
    assert_same_state(before, scene_state(slow_rig))
    assert TEMPORARY_SCENE_NAME not in bpy.data.scenes
    assert all(
        constraint.mute == (bone.name == "extra.2")
        for bone in slow_rig.armature_object.pose.bones
        for constraint in bone.constraints
    )
    parts = {(part.kind, part.name): part.duration.median for part in profile.parts}
    assert set(parts) >= {(BONES, ""), (MODIFIER, "CorrectiveSmooth"), (MODIFIER, "Armature"), (REST, "")}
    assert parts[MODIFIER, "CorrectiveSmooth"] > 0.4 * profile.frame.median
    assert profile.total == pytest.approx(profile.frame.median, rel=0.3)
    assert profile.times.is_estimate and profile.times.model_count == 1
    sentences = profile.savings_sentences()
    assert sentences[0].startswith("The most expensive modifier is CorrectiveSmooth of elbow: ")
    assert sentences[1] == f"The model: {profile.frame.median / profile.times.ratio:.2f} ms. {profile.times.sentence}"


def test_shape_keys_and_their_drivers_are_parts(slow_rig):
    drive(add_key(slow_rig.mesh_object, "bulge", np.copy), "value", slow_rig.armature_object, BEND)
    before = scene_state(slow_rig)
    profile = profile_of(slow_rig)
    assert_same_state(before, scene_state(slow_rig))
    parts = {part.kind: part for part in profile.parts}
    assert parts[KEY_DRIVERS].title == "elbow: Drivers of Shape Keys" and SHAPE_KEYS in parts


def test_a_duration_is_the_median_with_half_the_distance_of_the_quartiles():
    assert Duration.of([5.0, 1.0, 2.0, 3.0, 4.0]) == Duration(3.0, 1.0)
    assert Duration.of([-2.0, -1.0, 0.0]).median == 0, "a difference within the noise is no negative time"


def test_the_verb_writes_the_profile(elbow_files, tmp_path, capfd):
    path = tmp_path / "profile.json"
    assert run("benchmark", elbow_files.rig, "--profile", "--json", path) == 0
    profile = json.loads(path.read_text())["profile"]
    assert {part["kind"] for part in profile["parts"]} >= {"bones", "modifier", "rest"}
    assert profile["frame"]["median"] > 0 and profile["frame"]["spread"] >= 0
    assert profile["fast_rig"]["kept_bones"] == profile["fast_rig"]["bones"] == 2 and not profile["fast_rig_problem"]
    output = capfd.readouterr().out
    assert "A frame takes" in output and "The model: " in output
    assert "A fast rig would keep all 2 bones, because the visible controls (2) and joints (2) need them" in output


def test_a_fast_rig_leaves_out_the_slow_bone_that_nothing_needs(slow_rig, tmp_path, capfd):
    """Only the twelve hidden bones may go, and with them the 400 constraints that take nearly all time of the bones."""
    hide_extra_bones(slow_rig)
    file, path = tmp_path / "slow.blend", tmp_path / "saving.json"
    bpy.ops.wm.save_as_mainfile(filepath=str(file))
    content = file.read_bytes()
    assert run("benchmark", file, "--fast-rig", "--json", path) == 0
    saving = json.loads(path.read_text())
    assert [saving[key] for key in ("bones", "kept_bones", "joints", "controls")] == [14, 2, 2, 2]
    assert saving["fast"] < saving["full"] and saving["unit"] == "ms"
    assert "would keep 2 of 14 bones" in capfd.readouterr().out
    assert file.read_bytes() == content


def test_the_profile_says_why_no_fast_rig_can_be_made(slow_rig, tmp_path, capfd):
    """The bones of an armature that another object uses too cannot be removed."""
    hide_extra_bones(slow_rig)
    other = bpy.data.objects.new("other", slow_rig.armature_object.data)
    bpy.context.scene.collection.objects.link(other)
    file, path = tmp_path / "shared.blend", tmp_path / "profile.json"
    bpy.ops.wm.save_as_mainfile(filepath=str(file))
    assert run("benchmark", file, "--profile", "--json", path) == 0
    profile = json.loads(path.read_text())["profile"]
    assert profile["fast_rig"] is None and profile["fast_rig_problem"].startswith("'other' uses the armature of")
    assert "A fast rig cannot be made: 'other' uses the armature of" in capfd.readouterr().out


def fail_to_write(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_the_profile_stays_if_the_fast_rig_cannot_be_written(slow_rig, tmp_path, monkeypatch, capfd):
    """The measurement of the frame has taken minutes on large rigs."""
    hide_extra_bones(slow_rig)
    file, path = tmp_path / "rig.blend", tmp_path / "profile.json"
    bpy.ops.wm.save_as_mainfile(filepath=str(file))
    monkeypatch.setattr(blend_file, "remove_file", fail_to_write)
    assert run("benchmark", file, "--profile", "--json", path) == TRY_AGAIN
    profile = json.loads(path.read_text())["profile"]
    problem = "No temporary file can be written (No space left on device); make room there, or name another folder in"
    assert profile["parts"] and profile["fast_rig_problem"].startswith(problem)
    assert problem in capfd.readouterr().err


@pytest.mark.parametrize("option", ["--profile", "--fast-rig"])
def test_a_full_temporary_disk_is_refused_before_the_measurement(elbow_files, tmp_path, monkeypatch, capfd, option):
    path = tmp_path / "out.json"
    with monkeypatch.context() as patch:  # capfd writes temporary files, too
        patch.setattr(tempfile, "tempdir", None)
        patch.setattr(tempfile, "_candidate_tempdir_list", lambda: [str(tmp_path / "missing")])
        assert run("benchmark", elbow_files.rig, option, "--json", path) == TRY_AGAIN
    assert not path.exists()
    assert capfd.readouterr().err.startswith("Error: No temporary file can be written (No usable temporary directory")


@pytest.mark.parametrize("arguments", [["m.onnx", "--profile"], ["m.onnx", "--fast-rig"]])
def test_a_profile_takes_no_model(elbow_files, tmp_path, capfd, arguments):
    assert run("benchmark", elbow_files.rig, *arguments, "--json", tmp_path / "p.json") == 2
    assert "--profile and --fast-rig take no model" in capfd.readouterr().err


def test_a_bound_model_does_not_play_while_its_rig_is_profiled(bound_elbow):
    bpy.context.view_layer.objects.active = bound_elbow
    assert bpy.ops.fdda.profile_frame() == {"FINISHED"}
    assert bound_elbow.fdda.mode == "FDDA" and not bound_elbow.fdda.status
    parts = {
        part.name
        for part in measurements.last(measurements.PROFILE, bpy.data.objects[ELBOW_RIG]).parts
        if part.kind == MODIFIER
    }
    assert parts == {"Armature", "CorrectiveSmooth"}


def drawn_texts(rig: SceneRig) -> list[str]:
    drawn = []
    context = SimpleNamespace(region=SimpleNamespace(width=300), preferences=bpy.context.preferences)
    draw_profile(Layout(drawn), context, rig)
    return [element.text for element in drawn]


def test_the_button_stores_the_profile_and_the_sidebar_draws_a_bar_with_the_shares(slow_rig, monkeypatch):
    hide_extra_bones(slow_rig)
    assert measurements.last(measurements.PROFILE, slow_rig.armature_object) is None
    assert bpy.ops.fdda.profile_frame() == {"FINISHED"}
    profile = measurements.last(measurements.PROFILE, slow_rig.armature_object)
    assert (profile.fast_rig.bones, profile.fast_rig.kept_bones) == (14, 2) and not profile.fast_rig_problem
    assert profile.fast_rig.full > profile.fast_rig.fast
    assert len(slow_rig.armature_object.data.bones) == 14, "only a copy was pruned"
    texts = drawn_texts(slow_rig)
    assert f"Frame Profile ({profile.total:.1f} ms)" in texts
    assert job.state_of("profile_frame").outcome.startswith(f"A frame takes {profile.total:.2f} ms; ")
    part, share = f"{profile.parts[0].duration} ms {profile.parts[0].title}", profile.parts[0].duration.median
    assert f"A {share / profile.total:.0%} {part}" in " ".join(" ".join(texts).split())
    segments = [text for text in texts if text in {"A", "B", "C", "D"}]
    wide_parts = sum(part.duration.median >= 0.05 * profile.total for part in profile.parts)
    assert "".join(segments) == "ABCD"[:wide_parts]
    sentences = profile.savings_sentences()
    assert len(sentences) == 3
    assert all(sentence.split(" ms")[0] in " ".join(texts) for sentence in sentences)
    # Without a graphics card, drawing takes a hundred times as long as the rig. It hides no part.
    drawing = FramePart(DRAWING, "", "", Duration(1000 * profile.frame.median, 0.0))
    monkeypatch.setattr(measurements, "last", lambda *_: replace(profile, parts=(*profile.parts, drawing)))
    drawn_text = " ".join(" ".join(drawn_texts(slow_rig)).split())
    assert f"A <1% {part}" in drawn_text
    assert f" {drawing.duration} ms Drawing" in drawn_text
