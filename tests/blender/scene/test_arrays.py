# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading and writing arrays of RNA properties, whose declared types match Blender's."""

import bpy
import numpy as np
import pytest

from fdda_addon.scene import arrays
from fdda_addon.scene.arrays import (
    COORDINATE_ELEMENT,
    LOOP_START_ELEMENT,
    POSE_CHANNELS,
    POSE_MATRIX_ELEMENT,
    VECTOR_ELEMENT,
)
from fdda_addon.scene.mesh import mesh_positions, set_mesh_positions

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
