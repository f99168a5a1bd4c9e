# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters with a modifier more, the smallest recording of them, and what a refusal of them must be."""

from collections.abc import Callable
from pathlib import Path

import bpy
import pytest

from blend_fixtures.characters import stacks
from blend_fixtures.characters.base import tube
from fdda_addon.core.errors import RigError
from fdda_addon.evaluation.run import EvaluationSettings, evaluate
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.rig_check import check_recordable_rig
from fdda_addon.recording.run import record
from fdda_addon.runtime.binding import bind
from fdda_addon.scene.scene_rig import SceneRig, find_rig

from .conftest import ELBOW
from .scene_state import assert_same_state, drain, scene_state

FEW_POSES = RecordingSettings(poses=4, influence_poses=1)


def build_rig(build: Callable[[], object] = tube) -> SceneRig:
    """Build a character in the empty scene."""
    build()
    return find_rig(ELBOW)


def assert_refused(rig: SceneRig, model: Path, recording: Path, sentence: str) -> None:
    """Check, record, evaluate and bind say the same sentence; nothing is written, and the scene is as before."""
    before = scene_state(rig)
    for refused in (
        lambda: drain(record(rig, recording, FEW_POSES)),
        lambda: drain(evaluate(rig, model, EvaluationSettings(poses=2))),
        lambda: bind(rig, model),
    ):
        with pytest.raises(RigError) as error:
            refused()
        assert str(error.value) == sentence
    assert sentence in check_recordable_rig(rig).problems
    assert_same_state(before, scene_state(rig))
    assert not recording.exists()


def add_modifier_at(place: int, kind: str, **settings: object) -> Callable[[bpy.types.Object], None]:
    def add(mesh_object: bpy.types.Object) -> None:
        modifier = mesh_object.modifiers.new("It", kind)
        for name, value in settings.items():
            setattr(modifier, name, value)
        mesh_object.modifiers.move(len(mesh_object.modifiers) - 1, place)

    return add


def add_nodes_at(place: int, *kinds: str) -> Callable[[bpy.types.Object], None]:
    def add(mesh_object: bpy.types.Object) -> None:
        add_modifier_at(place, "NODES", node_group=stacks.chain("Group", *kinds))(mesh_object)

    return add
