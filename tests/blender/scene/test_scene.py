# SPDX-License-Identifier: GPL-3.0-or-later
"""Arrays of RNA properties, and poses without keyframes, which stay when Blender sets the current frame again."""

import bpy
import numpy as np
import pytest

from fdda_addon.scene import arrays, unkeyed_changes
from fdda_addon.scene.arrays import (
    COORDINATE_ELEMENT,
    LOOP_START_ELEMENT,
    POSE_CHANNELS,
    POSE_MATRIX_ELEMENT,
    VECTOR_ELEMENT,
)
from fdda_addon.scene.mesh import mesh_positions, set_mesh_positions
from fdda_addon.scene.temporary_state import temporary_pose

from ..scene_state import fresh_elbow

ELEMENTS_BY_OWNER = {
    "MeshVertex": (COORDINATE_ELEMENT,),
    "ShapeKeyPoint": (COORDINATE_ELEMENT,),
    "FloatVectorAttributeValue": (VECTOR_ELEMENT,),
    "MeshNormalValue": (VECTOR_ELEMENT,),
    "FloatColorAttributeValue": (arrays.COLOR_ELEMENT,),
    "ShapeKey": (arrays.KEY_VALUE_ELEMENT, arrays.MUTE_ELEMENT),
    "MeshPolygon": (LOOP_START_ELEMENT, arrays.MATERIAL_INDEX_ELEMENT),
    "MeshLoop": (arrays.VERTEX_INDEX_ELEMENT,),
    "MeshEdge": (arrays.EDGE_ELEMENT,),
    "MeshLoopTriangle": (arrays.TRIANGLE_ELEMENT,),
    "PoseBone": (POSE_MATRIX_ELEMENT, *POSE_CHANNELS),
    "Bone": (arrays.REST_MATRIX_ELEMENT,),
    "Keyframe": arrays.KEYFRAME_ELEMENTS,
}
"""Declared elements by the RNA type that has them."""

DTYPES = {"FLOAT": np.float32, "INT": np.int32, "ENUM": np.int32, "BOOLEAN": np.bool_}


@pytest.mark.parametrize("owner", ELEMENTS_BY_OWNER)
def test_declared_types_are_those_of_blender(owner):
    for element in ELEMENTS_BY_OWNER[owner]:
        rna = getattr(bpy.types, owner).bl_rna.properties[element.name]
        shape = tuple(size for size in getattr(rna, "array_dimensions", ()) if size)
        assert (DTYPES[rna.type], shape) == (element.dtype, element.shape), element.name


def test_written_arrays_are_read_back():
    mesh = bpy.data.meshes.new("three")
    mesh.vertices.add(3)
    positions = np.arange(9, dtype=np.float32).reshape(3, 3)
    arrays.write(mesh.vertices, COORDINATE_ELEMENT, positions)
    for read_positions in (arrays.read(mesh.vertices, COORDINATE_ELEMENT), mesh_positions(mesh)):
        assert read_positions.dtype == np.float32 and np.array_equal(read_positions, positions)
    # Rows that are not contiguous are written in their order, too.
    set_mesh_positions(mesh, np.asfortranarray(-positions))
    kept = np.empty((3, 3), np.float32)
    arrays.read(mesh.attributes["position"].data, VECTOR_ELEMENT, kept)
    assert np.array_equal(kept, -positions)
    assert arrays.read(mesh.polygons, LOOP_START_ELEMENT).shape == (0,)


FRAME = 12


@pytest.fixture
def posed_rig(monkeypatch):
    """Build an elbow with a keyed bone, a keyed location and a keyed property that were changed without keyframes.

    Returns:
        A function that returns the three values.
    """
    armature_object = fresh_elbow().armature_object
    armature_object["wrinkle"] = 0.0
    for frame in (1, 30):
        armature_object.keyframe_insert("location", frame=frame)
        armature_object.keyframe_insert('["wrinkle"]', frame=frame)
    bpy.context.scene.frame_set(FRAME)
    bone = armature_object.pose.bones["lower"]
    bone.rotation_euler[0], armature_object.location[2], armature_object["wrinkle"] = 1.25, 3.0, 0.5
    # Without a window, Blender never sets the frame again by itself, and nothing is requested.
    unkeyed_changes.keep_unkeyed_changes()
    assert unkeyed_changes._request.frame is None
    monkeypatch.setattr(unkeyed_changes._request, "frame", float(FRAME))

    def values() -> tuple[float, float, float]:
        bpy.context.view_layer.update()
        return bone.rotation_euler[0], armature_object.location[2], armature_object["wrinkle"]

    return values


def test_the_same_frame_keeps_unkeyed_changes(posed_rig):
    for _ in range(2):
        bpy.context.scene.frame_set(FRAME)
        assert posed_rig() == (1.25, 3.0, 0.5)


def test_without_a_request_the_animation_wins(posed_rig):
    unkeyed_changes.discard_requests()
    bpy.context.scene.frame_set(FRAME)
    rotation, location, wrinkle = posed_rig()
    assert abs(rotation - 1.25) > 0.1 and location == 0 and wrinkle == 0


def test_another_frame_ends_the_request(posed_rig):
    bpy.context.scene.frame_set(FRAME + 1)
    assert posed_rig()[1:] == (0, 0)
    bpy.context.scene.frame_set(FRAME)
    rotation, location, wrinkle = posed_rig()
    assert abs(rotation - 1.25) > 0.1 and location == 0 and wrinkle == 0


def test_a_job_keeps_unkeyed_changes_of_other_objects():
    armature_object = fresh_elbow().armature_object
    scene, other = bpy.context.scene, bpy.data.objects.new("other", bpy.data.cameras.new("other"))
    removed = bpy.data.objects.new("removed", None)
    for added in (other, removed):
        scene.collection.objects.link(added)
        for frame in (1, 30):
            added.keyframe_insert("location", frame=frame)
    other.data.keyframe_insert("lens", frame=1)
    for name in ("first", "last"):
        other[name] = 1.0
        other.keyframe_insert(f'["{name}"]', frame=1)
    scene.frame_set(FRAME)
    other.location[1], other.data.lens = 2.5, 80.0
    with temporary_pose(armature_object):
        scene.frame_set(FRAME + 5)
        assert other.location[1] == 0
        bpy.data.objects.remove(removed)
        del other["first"], other["last"]
    bpy.context.view_layer.update()
    evaluated = other.evaluated_get(bpy.context.evaluated_depsgraph_get())
    assert (evaluated.location[1], evaluated.data.lens, scene.frame_current) == (2.5, 80.0, FRAME)
