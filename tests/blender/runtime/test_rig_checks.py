# SPDX-License-Identifier: GPL-3.0-or-later
"""When a playing model checks its rig: posing and frames read as little as possible, in a window only after a pause."""

from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from fdda_addon.runtime import playback, rig_signature
from fdda_addon.runtime import session as session_module
from fdda_addon.runtime.session import session
from fdda_addon.runtime.transitions import State
from fdda_addon.scene.scene_rig import SceneRig, armature_modifier

from ..conftest import ELBOW_RIG, assert_plays, pose
from ..crowds import crowd_of
from ..evaluations import add_shape_key
from ..rig_changes import add_bone, change_in_edit_mode, drive_b_bone, edit_bones
from .test_changed_rigs import assert_rig_shown


def test_playback_and_posing_do_not_check_the_rig(bound_elbow, elbow_files, monkeypatch):
    """Frame changes, posing and driven shape keys do not read the rig again."""
    add_shape_key(bound_elbow)
    key = bound_elbow.data.shape_keys.key_blocks["bulge"]
    driver = key.driver_add("value").driver
    variable = driver.variables.new()
    variable.type, variable.targets[0].id = "TRANSFORMS", bpy.data.objects[ELBOW_RIG]
    variable.targets[0].bone_target, variable.targets[0].transform_type = "lower", "ROT_X"
    driver.type = "SUM"
    pose(angle=0.2)
    pose(angle=0.3)
    monkeypatch.setattr(rig_signature, "read_model_rig", None)
    monkeypatch.setattr(rig_signature, "rest_digest", None)
    for frame in range(5):
        bpy.context.scene.frame_set(frame)
        pose(angle=0.1 * frame)
    assert_plays(bound_elbow, elbow_files.model)


def test_posing_reads_the_bones_of_a_shared_armature_once_and_no_modifiers(bound_elbow, elbow_files, monkeypatch):
    crowd = crowd_of(bound_elbow, 3)
    bpy.context.view_layer.update()
    counts = Counter()
    for name in ("bone_signature", "read_modifiers_and_drivers"):
        function = getattr(rig_signature, name)
        monkeypatch.setattr(
            rig_signature,
            name,
            lambda *arguments, name=name, function=function: counts.update([name]) or function(*arguments),
        )
    for angle in (0.2, 0.4):
        pose(angle=angle)
        for mesh_object in crowd:
            assert_plays(mesh_object, elbow_files.model)
    assert counts == {"bone_signature": 2}


def test_a_frame_reads_no_bones_of_driven_armature_data(bound_elbow, elbow_files, monkeypatch):
    drive_b_bone()
    monkeypatch.setattr(rig_signature, "bone_signature", None)
    shown = []
    for frame in (5, 12, 25):
        bpy.context.scene.frame_set(frame)
        shown.append(assert_plays(bound_elbow, elbow_files.model))
    assert np.abs(shown[0] - shown[-1]).max() > 1e-3


def test_a_bone_without_weights_that_becomes_a_b_bone_shows_the_rig(bound_elbow, elbow_files, capsys):
    change_in_edit_mode(bpy.data.objects[ELBOW_RIG], lambda: add_bone("control"))
    pose(angle=0.3)
    assert_plays(bound_elbow, elbow_files.model)
    bpy.data.objects[ELBOW_RIG].data.bones["control"].bbone_segments = 3
    pose(angle=0.4)
    assert_rig_shown(bound_elbow, "the bone 'control' was no B-Bone when it was recorded", capsys)


@pytest.mark.parametrize("change", ["use_deform", "rest pose", "name"])
def test_a_changed_bone_without_weights_lets_the_rig_be_read_again(bound_elbow, elbow_files, change, monkeypatch):
    """Whether a bone has an effect is for `read_model_rig` to tell: it chooses the joints and their parents."""
    armature_object, reads = bpy.data.objects[ELBOW_RIG], []
    change_in_edit_mode(armature_object, lambda: add_bone("control"))
    pose(angle=0.3)
    read = rig_signature.read_model_rig
    monkeypatch.setattr(rig_signature, "read_model_rig", lambda *arguments: reads.append(1) or read(*arguments))
    pose(angle=0.35)
    assert not reads
    if change == "rest pose":
        change_in_edit_mode(armature_object, lambda: edit_bones()["control"].head.__setitem__(0, 2.0))
    else:
        setattr(armature_object.data.bones["control"], change, False if change == "use_deform" else "renamed")
    pose(angle=0.4)
    assert reads
    assert_plays(bound_elbow, elbow_files.model)


def test_envelopes_are_compared_only_where_they_have_an_effect(bound_elbow):
    armature_object = bpy.data.objects[ELBOW_RIG]
    rig = SceneRig(bound_elbow, armature_object)

    def bones() -> tuple:
        return rig_signature.read_signature(rig, parts=["bones"])["bones"]

    for has_effect in (False, True):
        armature_modifier(bound_elbow).use_bone_envelopes = has_effect
        before = bones()
        assert bones() == before
        armature_object.data.bones["lower"].envelope_distance += 0.1
        assert (bones() != before) is has_effect


@pytest.fixture
def window(monkeypatch) -> SimpleNamespace:
    """A stand-in for what the session asks of Blender: a window, in which timers run."""
    timers: list[Callable[[], float | None]] = []
    registered = SimpleNamespace(is_registered=timers.__contains__, register=lambda timer, **_: timers.append(timer))
    app = SimpleNamespace(background=False, timers=registered)
    for module in (session_module, playback):
        monkeypatch.setattr(module, "bpy", Proxy(bpy, app=app))
    return SimpleNamespace(timers=timers)


class Proxy:
    """A module with some attributes replaced."""

    def __init__(self, module: object, **replaced: object):
        self._module = module
        vars(self).update(replaced)

    def __getattr__(self, name: str) -> object:
        return getattr(self._module, name)


def test_in_a_window_posing_reads_no_bones_until_it_pauses(bound_elbow, elbow_files, window, monkeypatch, capsys):
    drive_b_bone()
    read_parts, read_signature = [], rig_signature.read_signature
    monkeypatch.setattr(
        rig_signature,
        "read_signature",
        lambda *arguments: read_parts.append(set(arguments[-1])) or read_signature(*arguments),
    )
    monkeypatch.setattr(session_module, "CHECK_DELAY_S", 1e6)
    for angle in (0.2, 0.4, 0.6):
        pose(angle=angle)
        assert_plays(bound_elbow, elbow_files.model)
    assert not read_parts and window.timers == [session.check_timer]
    assert session.check_timer() > 0, "posing has not paused long enough"
    assert not read_parts
    monkeypatch.setattr(session_module, "CHECK_DELAY_S", 0)
    assert session.check_timer() is None
    assert read_parts == [{"bones", "object"}] and not bound_elbow.fdda.status
    assert session.characters[bound_elbow.session_uid].state == State.PLAYING
    bpy.data.objects[ELBOW_RIG].data.bones["lower"].use_deform = False
    pose(angle=0.8)
    assert bound_elbow.fdda.mode == "FDDA"
    assert session.check_timer() is None
    bpy.context.view_layer.update()
    assert_rig_shown(bound_elbow, "some vertices follow no bone", capsys)


def test_in_a_window_a_frame_checks_what_has_changed_before(bound_elbow, window, capsys):
    pose(angle=1.0)
    bpy.data.objects[ELBOW_RIG].data.bones["lower"].use_deform = False
    bpy.context.view_layer.update()
    assert bound_elbow.fdda.mode == "FDDA"
    bpy.context.scene.frame_set(7)
    assert_rig_shown(bound_elbow, "some vertices follow no bone", capsys)
