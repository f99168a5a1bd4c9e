# SPDX-License-Identifier: GPL-3.0-or-later
"""Shape keys are muted while a model plays and restored when the rig is shown."""

import bpy
import numpy as np

from .conftest import assert_plays, evaluated_positions, pose, rig_positions
from .evaluations import add_shape_key


def test_shape_keys_are_restored_with_the_rig(bound_elbow, elbow_files):
    add_shape_key(bound_elbow)
    pose(angle=1.1)
    assert_plays(bound_elbow, elbow_files.model)
    shown = rig_positions(bound_elbow)
    bound_elbow.data.shape_keys.key_blocks["bulge"].value = 0
    bpy.context.view_layer.update()
    assert_plays(bound_elbow, elbow_files.model)
    assert np.abs(rig_positions(bound_elbow) - shown).max() > 1e-3
    assert not bound_elbow.show_only_shape_key and not any(key.mute for key in bound_elbow.data.shape_keys.key_blocks)


def test_shape_keys_are_not_mixed_while_a_model_plays(bound_elbow):
    add_shape_key(bound_elbow)
    bulge = bound_elbow.data.shape_keys.key_blocks["bulge"]

    def muted() -> list[bool]:
        keys = bound_elbow.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.shape_keys
        return [key.mute for key in keys.key_blocks]

    for angle, value in ((0.4, 1.0), (0.8, 1.0), (0.8, 0.5), (1.2, 0.5)):
        bulge.value = value
        pose(angle=angle)
        # What was set has been copied anew.
        pose(angle=angle + 0.01)
        assert muted() == [True] * len(bound_elbow.data.shape_keys.key_blocks)
    bound_elbow.fdda.mode = "RIG"
    bpy.context.view_layer.update()
    bulge.value = 1.0
    bpy.context.view_layer.update()
    assert not any(muted())


def test_an_undeformed_shape_key_added_during_playback_is_muted(bound_elbow, elbow_files):
    pose(angle=0.3)
    assert_plays(bound_elbow, elbow_files.model)
    bound_elbow.shape_key_add(name="Basis")
    # A new key displaces no vertex, so the model still plays.
    bound_elbow.shape_key_add(name="bulge").value = 1
    for angle in (0.5, 0.7, 0.9):
        pose(angle=angle)
    keys = bound_elbow.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.shape_keys
    assert [key.mute for key in keys.key_blocks] == [True, True]
    assert_plays(bound_elbow, elbow_files.model)


def test_shape_keys_of_two_objects(bound_elbow, elbow_files):
    """Two objects share a mesh: one plays the model and the other shows the rig."""
    add_shape_key(bound_elbow)
    pose(angle=0.9)
    expected = rig_positions(bound_elbow)
    other = bound_elbow.copy()
    bpy.context.scene.collection.objects.link(other)
    other.fdda.mode = "RIG"
    for angle in (1.4, 0.9):
        pose(angle=angle)
    assert np.abs(evaluated_positions(other) - expected).max() < 1e-6
    assert_plays(bound_elbow, elbow_files.model)
