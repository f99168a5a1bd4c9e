# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters with an additional modifier, a small recording of them, and a check that they are refused."""

from collections.abc import Callable
from pathlib import Path

import bpy
import pytest

from blend_fixtures.characters import stacks
from blend_fixtures.characters.base import tube
from fdda_addon.core.errors import RigError
from fdda_addon.evaluation.run import evaluate
from fdda_addon.evaluation.settings import EvaluationSettings
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
    """Assert that check, record, evaluate and bind refuse a rig with one sentence, and change no file and no scene."""
    before = scene_state(rig)
    for call in (
        lambda: drain(record(rig, recording, FEW_POSES)),
        lambda: drain(evaluate(rig, model, EvaluationSettings(poses=2))),
        lambda: bind(rig, model),
    ):
        with pytest.raises(RigError) as error:
            call()
        assert str(error.value) == sentence
    assert sentence in check_recordable_rig(rig).problems
    assert_same_state(before, scene_state(rig))
    assert not recording.exists()


def add_modifier_at(index: int, kind: str, **settings: object) -> Callable[[bpy.types.Object], None]:
    """Return a function that adds a modifier to an object, at an index of its stack."""

    def add(mesh_object: bpy.types.Object) -> None:
        modifier = mesh_object.modifiers.new("It", kind)
        for name, value in settings.items():
            setattr(modifier, name, value)
        mesh_object.modifiers.move(len(mesh_object.modifiers) - 1, index)

    return add


def add_nodes_at(index: int, *kinds: str) -> Callable[[bpy.types.Object], None]:
    """Return a function that adds Geometry Nodes with a chain of nodes to an object, at an index of its stack."""

    def add(mesh_object: bpy.types.Object) -> None:
        add_modifier_at(index, "NODES", node_group=stacks.build_node_chain("Group", *kinds))(mesh_object)

    return add
