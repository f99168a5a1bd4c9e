# SPDX-License-Identifier: GPL-3.0-or-later
"""Mesh, constraints and action of the elbow, the smallest rig of the tests."""

import math

import bpy
import numpy as np
import pytest

from blend_fixtures.elbow import LOWER_RANGE, UPPER_RANGE, build_elbow, elbow_surface

from .test_arm import assert_closed, evaluated_positions, rest_positions


def test_the_elbow_is_a_small_closed_tube():
    points, faces = elbow_surface()
    assert 250 <= len(points) <= 400
    assert_closed(points, faces)


def test_constraints_define_the_range_of_motion_of_the_elbow():
    mesh_object, rig = build_elbow()
    assert (mesh_object.name, rig.name) == ("elbow", "elbow_rig")
    assert {bone.name: bone.parent and bone.parent.name for bone in rig.data.bones} == {"upper": None, "lower": "upper"}
    for name, ranges in (("upper", UPPER_RANGE), ("lower", LOWER_RANGE)):
        (limit,) = rig.pose.bones[name].constraints
        assert (limit.type, limit.owner_space) == ("LIMIT_ROTATION", "LOCAL")
        for axis, (low, high) in zip("xyz", ranges, strict=True):
            assert getattr(limit, f"use_limit_{axis}")
            assert math.degrees(getattr(limit, f"min_{axis}")) == pytest.approx(low, abs=1e-4)
            assert math.degrees(getattr(limit, f"max_{axis}")) == pytest.approx(high, abs=1e-4)
    sums = [sum(group.weight for group in vertex.groups) for vertex in mesh_object.data.vertices]
    assert np.allclose(sums, 1.0, atol=1e-6)
    assert sum(len(vertex.groups) == 2 for vertex in mesh_object.data.vertices) >= 24


def test_the_action_moves_the_tip_of_the_elbow():
    mesh_object, rig = build_elbow()
    assert rig.animation_data.action.name == "elbow_wave"
    scene = bpy.context.scene
    assert (scene.frame_start, scene.frame_end) == (1, 30)
    first_positions = evaluated_positions(mesh_object)
    scene.frame_set(10)
    tip = rest_positions(mesh_object)[:, 0].argmax()
    assert np.linalg.norm(evaluated_positions(mesh_object)[tip] - first_positions[tip]) > 0.2
