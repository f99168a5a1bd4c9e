# SPDX-License-Identifier: GPL-3.0-or-later
"""Characters with various transforms, parents and units are recorded, trained and bound, and play their model."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters.transforms import CENTIMETRES, TRANSFORMS
from fdda_addon.runtime.binding import bind
from fdda_addon.scene.blend_file import save_copy
from fdda_addon.scene.scene_rig import armature_modifier, find_rig

from ..conftest import ELBOW, ELBOW_RIG, assert_plays, evaluated_positions, predicted_positions, run

POSES = ((0.3, -0.2, 0.1), (1.2, 0.5, -0.4), (1.9, 0.1, 0.6))
"""Radians: the bend of the lower bone, two turns of the upper one."""

BEST_PART = 0.3
"""What the model's error may be of linear skinning's, after so short a training."""


@pytest.fixture(params=TRANSFORMS, ids=lambda build: build.__name__)
def character(request, trained_elbow) -> tuple[bpy.types.Object, Path, float]:
    """The mesh object with its model bound, the model, and how many units of the mesh make a meter."""
    files = trained_elbow(request.param)
    bpy.ops.wm.open_mainfile(filepath=str(files.rig))
    bind(find_rig(), files.model)
    mesh_object = bpy.data.objects[ELBOW]
    size = CENTIMETRES if max(mesh_object.dimensions) / min(mesh_object.matrix_world.to_scale()) > 10 else 1.0
    return mesh_object, files.model, size


def show(mesh_object: bpy.types.Object, mode: str) -> np.ndarray:
    mesh_object.fdda.mode = mode
    return evaluated_positions(mesh_object)


def assert_equal(mesh_object: bpy.types.Object, model: Path, size: float) -> None:
    assert np.abs(show(mesh_object, "FDDA") - predicted_positions(mesh_object, model)).max() < 1e-5 * size
    assert not mesh_object.fdda.status


def errors(mesh_object: bpy.types.Object) -> np.ndarray:
    """Mean errors of the model and of linear skinning in this pose, units of the mesh."""
    true, playing, linear = (show(mesh_object, mode) for mode in ("RIG", "FDDA", "LINEAR"))
    return np.array([np.linalg.norm(positions - true, axis=1).mean() for positions in (playing, linear)])


def test_frames_of_an_action_and_other_poses(character):
    """The elbow's own action, and that of the empty where there is one."""
    mesh_object, model, size = character
    in_frames, in_poses = [], []
    for frame in (4, 15, 26):
        bpy.context.scene.frame_set(frame)
        assert_equal(mesh_object, model, size)
        in_frames.append(errors(mesh_object))
        linear = show(mesh_object, "LINEAR")
        mesh_object.fdda.mode = "RIG"
        mesh_object.modifiers["CorrectiveSmooth"].show_viewport = False
        largest = np.abs(evaluated_positions(mesh_object) - linear).max()
        mesh_object.modifiers["CorrectiveSmooth"].show_viewport = True
        # Blender itself computes in single precision here.
        assert largest < 1e-5 * size + 1e-6 * np.abs(mesh_object.matrix_world.translation).max()
    armature_object = bpy.data.objects[ELBOW_RIG]
    armature_object.animation_data_clear()
    for bend, turn, twist in POSES:
        armature_object.pose.bones["lower"].rotation_euler[0] = bend
        armature_object.pose.bones["upper"].rotation_euler = (turn, twist, 0.0)
        bpy.context.view_layer.update()
        assert_equal(mesh_object, model, size)
        in_poses.append(errors(mesh_object))
    for found in (in_frames, in_poses):
        model_error, linear_error = np.mean(found, axis=0)
        assert model_error < BEST_PART * linear_error


def test_a_character_survives_an_animated_scale_of_zero(bound_elbow, elbow_files, capsys):
    """At scale 0 the character is invisible. Other characters play on, and it plays again afterwards."""
    armature_object = bpy.data.objects[ELBOW_RIG]
    hider = bpy.data.objects.new("hider", None)
    bpy.context.scene.collection.objects.link(hider)
    other_rig, other = armature_object.copy(), bound_elbow.copy()
    for copy in (other_rig, other):
        bpy.context.scene.collection.objects.link(copy)
    other.parent = armature_modifier(other).object = other_rig
    armature_object.parent = hider
    for frame, scale in ((4, (1, 1, 1)), (5, (0, 0, 0)), (10, (0, 0, 0)), (11, (0.5, 0.5, 0.5)), (20, (0, 1, 1))):
        hider.scale = scale
        hider.keyframe_insert("scale", frame=frame)
    for frame in (3, 7, 11, 20, 4):
        bpy.context.scene.frame_set(frame)
        assert_plays(other, elbow_files.model)
        assert (bound_elbow.fdda.mode, bound_elbow.fdda.status) == ("FDDA", "")
        if frame not in (7, 20):
            assert_plays(bound_elbow, elbow_files.model)
    assert "Traceback" not in "".join(capsys.readouterr())


def test_a_scale_of_zero_is_not_recorded(rig, capsys, tmp_path):
    rig.armature_object.keyframe_insert("scale", frame=1)
    rig.armature_object.scale = (1, 0, 1)
    rig.armature_object.keyframe_insert("scale", frame=5)
    action = rig.armature_object.animation_data.action.name
    bpy.context.scene.frame_set(1)
    save_copy(tmp_path / "flat.blend")
    assert run("record", tmp_path / "flat.blend", tmp_path / "flat", "--poses", 0, "--action", action) == 1
    assert (
        "has a scale of zero in some pose; look for the key, constraint or driver that sets it."
        in capsys.readouterr().err
    )
