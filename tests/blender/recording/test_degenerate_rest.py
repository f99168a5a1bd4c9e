# SPDX-License-Identifier: GPL-3.0-or-later
"""Rest poses that cannot be trained are refused before recording, with an error message that tells what to do."""

import math

import bpy
import numpy as np
import pytest

from fdda_addon.core.errors import RigError
from fdda_addon.recording.plan import RecordingSettings
from fdda_addon.recording.rig_check import check_recordable_rig
from fdda_addon.recording.run import record
from fdda_addon.scene.scene_rig import SceneRig

from ..scene_state import drain, fresh_elbow


def move_vertices(rig: SceneRig, change: object) -> None:
    mesh = rig.mesh_object.data
    points = np.array([vertex.co[:] for vertex in mesh.vertices], np.float32)
    change(points)
    mesh.vertices.foreach_set("co", points.ravel())
    mesh.update()


def set_vertex_to_nan(rig: SceneRig) -> None:
    move_vertices(rig, lambda points: points.__setitem__((3, 1), math.nan))


def set_vertices_to_infinity(rig: SceneRig) -> None:
    move_vertices(rig, lambda points: points.__setitem__(slice(5, 7), math.inf))


def collapse_mesh(rig: SceneRig) -> None:
    move_vertices(rig, lambda points: points.fill(1000.1))


def collapse_basis_key(rig: SceneRig) -> None:
    rig.mesh_object.shape_key_add(name="Basis")
    for point in rig.mesh_object.data.shape_keys.reference_key.data:
        point.co = (0, 0, 0)


def keep_one_vertex(rig: SceneRig) -> None:
    rig.mesh_object.data.clear_geometry()
    rig.mesh_object.data.vertices.add(1)


def set_bone_tail_to_nan(rig: SceneRig) -> None:
    bpy.context.view_layer.objects.active = rig.armature_object
    bpy.ops.object.mode_set(mode="EDIT")
    rig.armature_object.data.edit_bones["lower"].tail = (math.nan, 0, 0)
    bpy.ops.object.mode_set(mode="OBJECT")


def set_armature_location_to_nan(rig: SceneRig) -> None:
    rig.armature_object.location.x = math.nan
    bpy.context.view_layer.update()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            set_vertex_to_nan,
            "1 of 300 vertices of 'elbow' have coordinates that are not finite, the first is vertex 3;",
        ),
        (
            set_vertices_to_infinity,
            "2 of 300 vertices of 'elbow' have coordinates that are not finite, the first is vertex 5; delete",
        ),
        (
            collapse_mesh,
            "All 300 vertices of 'elbow' lie at one point in the rest pose, so the mesh has no size; give the",
        ),
        (collapse_basis_key, "All 300 vertices of 'elbow' lie at one point in the rest pose"),
        (keep_one_vertex, "The mesh of 'elbow' has one vertex, and no surface to learn; choose another object."),
        (
            set_bone_tail_to_nan,
            "The bone 'lower' has no length or no finite place in the rest pose; give its head and its tail",
        ),
        (
            set_armature_location_to_nan,
            "'elbow_rig' is at no finite place; clear the location, rotation and scale of it and of its",
        ),
    ],
)
def test_a_rest_pose_without_size_or_finite_location_is_refused(change, words, tmp_path):
    rig = fresh_elbow()
    change(rig)
    (problem,) = check_recordable_rig(rig).problems
    assert problem.startswith(words)
    with pytest.raises(RigError) as error:
        drain(record(rig, tmp_path / "recording", RecordingSettings(poses=3)))
    assert str(error.value) == problem and not (tmp_path / "recording").exists()
