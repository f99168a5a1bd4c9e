# SPDX-License-Identifier: GPL-3.0-or-later
"""While Blender finds the pose of a frame, models rest; what is shown in the end is what they say."""

from collections.abc import Iterator
from contextlib import contextmanager

import bpy
import numpy as np
import pytest
from conftest import ELBOW_RIG, assert_plays

from fdda_addon.runtime import nodes
from fdda_addon.scene.mesh import evaluated_positions, rest_positions

POSED = {1: 0.0, 2: 1.0, 3: 1.0, 4: 0.3}
"""Angle of the lower bone by frame; 2 and 3 show one pose."""


@pytest.fixture
def animated(bound: bpy.types.Object) -> bpy.types.Object:
    bone = bpy.data.objects[ELBOW_RIG].pose.bones["lower"]
    for frame, angle in POSED.items():
        bone.rotation_euler[0] = angle
        bone.keyframe_insert("rotation_euler", frame=frame)
    bpy.context.scene.frame_set(1)
    return bound


@contextmanager
def seen_at_first(mesh_object: bpy.types.Object) -> Iterator[list[np.ndarray]]:
    """What the mesh is when Blender has evaluated a frame for the first time, before the playback."""
    seen: list[np.ndarray] = []

    def look(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
        seen.append(evaluated_positions(mesh_object, depsgraph))

    bpy.app.handlers.frame_change_post.insert(0, look)
    try:
        yield seen
    finally:
        bpy.app.handlers.frame_change_post.remove(look)


def is_at_rest(positions: np.ndarray, mesh_object: bpy.types.Object) -> bool:
    return bool(np.abs(positions - rest_positions(mesh_object.data)).max() < 1e-6)


def test_frames_are_right_and_the_first_round_is_spared(animated, elbow):
    with seen_at_first(animated) as seen:
        for frame in (2, 3, 4, 4, 2):
            bpy.context.scene.frame_set(frame)
            positions = assert_plays(animated, elbow.model)
            assert not is_at_rest(positions, animated)
    assert len(seen) == 5 and all(is_at_rest(positions, animated) for positions in seen)


def test_nothing_of_the_scene_is_changed(animated):
    shown = []

    def look(*_: object) -> None:
        shown.append([modifier.show_viewport for modifier in animated.modifiers])

    expected = [modifier.show_viewport for modifier in animated.modifiers]
    # Behind the playback's own: it has let the model rest.
    bpy.app.handlers.frame_change_pre.append(look)
    try:
        bpy.context.scene.frame_set(2)
    finally:
        bpy.app.handlers.frame_change_pre.remove(look)
    assert shown == [expected] and nodes.find_modifier(animated).show_viewport


def test_nothing_rests_beside_a_simulation(animated, elbow):
    mesh = bpy.data.meshes.new("cloth")
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    cloth = bpy.data.objects.new("cloth", mesh)
    bpy.context.scene.collection.objects.link(cloth)
    bpy.context.scene.frame_set(2)
    bpy.context.view_layer.update()
    cloth.modifiers.new("Cloth", "CLOTH")
    bpy.context.view_layer.update()
    with seen_at_first(animated) as seen:
        for frame in (4, 2):
            bpy.context.scene.frame_set(frame)
            assert_plays(animated, elbow.model)
    assert not any(is_at_rest(positions, animated) for positions in seen)


def test_another_scene_may_simulate(animated):
    """What is known of one scene says nothing of another that shows the character too."""
    other = bpy.data.scenes.new("other")
    for shared in (animated, bpy.data.objects[ELBOW_RIG]):
        other.collection.objects.link(shared)
    cloth = bpy.data.objects.new("cloth", bpy.data.meshes.new("cloth"))
    cloth.modifiers.new("Cloth", "CLOTH")
    other.collection.objects.link(cloth)
    other.view_layers[0].update()
    bpy.context.view_layer.update()
    with seen_at_first(animated) as seen:
        bpy.context.scene.frame_set(2)
        other.frame_set(4)
    assert [is_at_rest(positions, animated) for positions in seen] == [True, False]


def test_nothing_rests_under_other_modifiers(animated, elbow):
    animated.modifiers.new("Wave", "WAVE").height = 0.0
    bpy.context.view_layer.update()
    with seen_at_first(animated) as seen:
        bpy.context.scene.frame_set(4)
        assert_plays(animated, elbow.model)
    assert not is_at_rest(seen[0], animated)


def test_the_rig_does_not_rest(animated):
    animated.fdda.mode = "RIG"
    bpy.context.view_layer.update()
    with seen_at_first(animated) as seen:
        bpy.context.scene.frame_set(2)
    assert not is_at_rest(seen[0], animated)
    assert np.abs(seen[0] - evaluated_positions(animated, bpy.context.evaluated_depsgraph_get())).max() == 0


def test_two_characters(animated, elbow):
    """One moves, the other keeps its pose: both show what their model says."""
    other = animated.copy()
    armature = bpy.data.objects[ELBOW_RIG].copy()
    armature.animation_data_clear()
    armature.pose.bones["lower"].rotation_euler[0] = 0.8
    for new in (other, armature):
        bpy.context.scene.collection.objects.link(new)
    other.modifiers["Armature"].object = armature
    bpy.context.view_layer.update()
    still = assert_plays(other, elbow.model)
    for frame in (2, 3, 4):
        bpy.context.scene.frame_set(frame)
        assert_plays(animated, elbow.model)
        assert np.array_equal(assert_plays(other, elbow.model), still)
