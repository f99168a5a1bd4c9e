# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes properties of RNA collections as numpy arrays, in the types of Blender.

`foreach_get` and `foreach_set` also accept an array of another type, which is a hundred times slower.
"""

from dataclasses import dataclass

import bpy
import numpy as np


@dataclass(frozen=True)
class ElementProperty:
    """A property of the elements of a collection.

    Attributes:
        name: name of the RNA property.
        dtype: type in which Blender stores it, so that it is copied without conversion.
        shape: shape of the values of one element; () for a single number.
    """

    name: str
    dtype: type[np.generic]
    shape: tuple[int, ...] = ()


COORDINATE_ELEMENT = ElementProperty("co", np.float32, (3,))
"""Position of a vertex or of a point of a shape key; object space."""
VECTOR_ELEMENT = ElementProperty("vector", np.float32, (3,))
"""Value of a vector attribute, or a vertex normal."""
COLOR_ELEMENT = ElementProperty("color", np.float32, (4,))
"""Value of a color attribute: linear RGBA."""
KEY_VALUE_ELEMENT = ElementProperty("value", np.float32)
"""Value of a shape key."""
MUTE_ELEMENT = ElementProperty("mute", np.bool_)
"""Whether a shape key is muted."""
LOOP_START_ELEMENT = ElementProperty("loop_start", np.int32)
VERTEX_INDEX_ELEMENT = ElementProperty("vertex_index", np.int32)
MATERIAL_INDEX_ELEMENT = ElementProperty("material_index", np.int32)
EDGE_ELEMENT = ElementProperty("vertices", np.int32, (2,))
EDGE_INDEX_ELEMENT = ElementProperty("edge_index", np.int32)
TRIANGLE_ELEMENT = ElementProperty("vertices", np.int32, (3,))
"""Vertices of a loop triangle."""
POSE_MATRIX_ELEMENT = ElementProperty("matrix", np.float32, (4, 4))
"""Matrix of a pose bone: armature space, column-major."""
REST_MATRIX_ELEMENT = ElementProperty("matrix_local", np.float32, (4, 4))
"""Rest matrix of a bone: armature space, column-major."""
POSE_CHANNELS = (
    ElementProperty("location", np.float32, (3,)),
    ElementProperty("rotation_euler", np.float32, (3,)),
    ElementProperty("rotation_quaternion", np.float32, (4,)),
    ElementProperty("rotation_axis_angle", np.float32, (4,)),
    ElementProperty("scale", np.float32, (3,)),
)
"""All properties of a pose bone that define its pose; angles in radians."""
KEY_POSITION_ELEMENT = ElementProperty("co", np.float32, (2,))
"""Frame and value of a keyframe."""
KEY_INTERPOLATION_ELEMENT = ElementProperty("interpolation", np.int32)
KEYFRAME_ELEMENTS = (
    KEY_POSITION_ELEMENT,
    ElementProperty("handle_left", np.float32, (2,)),
    ElementProperty("handle_right", np.float32, (2,)),
    KEY_INTERPOLATION_ELEMENT,
    ElementProperty("easing", np.int32),
    ElementProperty("amplitude", np.float32),
    ElementProperty("back", np.float32),
    ElementProperty("period", np.float32),
)
"""All properties of a keyframe that define the values of an F-curve."""


def read(
    collection: bpy.types.bpy_prop_collection, element: ElementProperty, values: np.ndarray | None = None
) -> np.ndarray:
    """Read the values of all elements of a collection.

    Args:
        values: contiguous array to read into; its length must be that of the collection. None for a new array.

    Returns:
        (n, *element.shape) of element.dtype.
    """
    if values is None:
        values = np.empty((len(collection), *element.shape), element.dtype)
    collection.foreach_get(element.name, values.reshape(-1))
    return values


def write(collection: bpy.types.bpy_prop_collection, element: ElementProperty, values: np.ndarray) -> None:
    """Set the values of all elements of a collection.

    Args:
        collection: n elements.
        values: (n, *element.shape) of element.dtype.
    """
    collection.foreach_set(element.name, values.reshape(-1))
