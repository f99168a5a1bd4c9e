# SPDX-License-Identifier: GPL-3.0-or-later
"""Reading and writing arrays of RNA properties: declared types match Blender's, and errors name the array."""

import bpy
import bpy.utils.previews
import numpy as np
import pytest

from fdda_addon.scene import arrays
from fdda_addon.scene.arrays import (
    COORDINATE_ELEMENT,
    LOOP_START_ELEMENT,
    POSE_CHANNELS,
    POSE_MATRIX_ELEMENT,
    VECTOR_ELEMENT,
    PropertyReader,
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


@pytest.fixture
def mesh() -> bpy.types.Mesh:
    mesh = bpy.data.meshes.new("three")
    mesh.vertices.add(3)
    return mesh


def test_written_arrays_are_read_back(mesh):
    positions = np.arange(9, dtype=np.float32).reshape(3, 3)
    arrays.write(mesh.vertices, COORDINATE_ELEMENT, positions)
    for read_positions in (arrays.read(mesh.vertices, COORDINATE_ELEMENT), mesh_positions(mesh)):
        assert read_positions.dtype == np.float32 and np.array_equal(read_positions, positions)
    set_mesh_positions(mesh, -positions)
    assert [tuple(vertex.co) for vertex in mesh.vertices] == [tuple(row) for row in (-positions).tolist()]
    assert arrays.read(mesh.polygons, LOOP_START_ELEMENT).shape == (0,)


@pytest.mark.parametrize(
    ("values", "shape"),
    [
        (np.zeros((2, 3), np.float32), r"\(2, 3\) float32"),
        (np.zeros((4, 3), np.float32), r"\(4, 3\) float32"),
        (np.zeros((3, 3)), r"\(3, 3\) float64"),
        (np.zeros(9, np.float32), r"\(9,\) float32"),
        (np.zeros((3, 3), np.float32).T, r"\(3, 3\) float32, not contiguous"),
    ],
)
def test_an_array_of_the_wrong_type_is_named_and_not_written(mesh, values, shape):
    arrays.write(mesh.vertices, COORDINATE_ELEMENT, np.ones((3, 3), np.float32))
    with pytest.raises(ValueError, match=rf"'co' of .*\[3\], MeshVertices.* is \(3,\) float32 each, .* is {shape}"):
        arrays.write(mesh.vertices, COORDINATE_ELEMENT, values)
    assert (mesh_positions(mesh) == 1).all()


def test_a_reader_refuses_data_of_another_size(mesh):
    reader = PropertyReader(VECTOR_ELEMENT, np.empty((3, 3), np.float32))
    set_mesh_positions(mesh, np.full((3, 3), 2, np.float32))
    reader.read(mesh.attributes["position"].data)
    assert (reader.values == 2).all()
    mesh.vertices.add(1)
    with pytest.raises(ValueError, match=r"'vector' of .*\[4\], FloatVectorAttribute.* the array is \(3, 3\) float32"):
        reader.read(mesh.attributes["position"].data)
    with pytest.raises(ValueError, match=r"'vector' of the array to read into is .* the array is \(3, 3\) float64"):
        PropertyReader(VECTOR_ELEMENT, np.empty((3, 3)))


def test_written_pixels_must_have_the_size_of_the_picture():
    previews = bpy.utils.previews.new()
    try:
        preview = previews.new("picture")
        preview.image_size = (4, 2)
        pixels = np.linspace(0, 1, 32, dtype=np.float32).reshape(2, 4, 4)
        arrays.write_pixels(preview, pixels)
        assert np.abs(np.reshape(preview.image_pixels_float[:], (2, 4, 4)) - pixels).max() < 0.01
        with pytest.raises(ValueError, match=r"\(2, 4, 4\) float32, the array is \(4, 2, 4\) float32"):
            arrays.write_pixels(preview, pixels.reshape(4, 2, 4))
    finally:
        bpy.utils.previews.remove(previews)
