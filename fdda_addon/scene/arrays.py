# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes properties of RNA collections as numpy arrays.

`foreach_get` and `foreach_set` also accept an array of another type, a hundred times slower, and in some cases one that
is too long. Here both are errors.
"""

from dataclasses import dataclass

import bpy
import numpy as np


@dataclass(frozen=True)
class Element:
    """A property of the elements of a collection.

    Attributes:
        name: name of the RNA property.
        dtype: type in which Blender stores it, so that it is copied without conversion.
        shape: shape of the values of one element; () for a single number.
    """

    name: str
    dtype: type[np.generic]
    shape: tuple[int, ...] = ()

    def empty(self, count: int) -> np.ndarray:
        """Allocate an uninitialized array (count, *shape) of dtype."""
        return np.empty((count, *self.shape), self.dtype)


COORDINATE_ELEMENT = Element("co", np.float32, (3,))
"""Of vertices and of the points of shape keys; object space."""
VECTOR_ELEMENT = Element("vector", np.float32, (3,))
"""Of vector attributes and of vertex normals."""
COLOR_ELEMENT = Element("color", np.float32, (4,))
"""Of color attributes: linear RGBA."""
MUTE_ELEMENT = Element("mute", np.bool_)
"""Of shape keys."""
LOOP_START = Element("loop_start", np.int32)
VERTEX_INDEX = Element("vertex_index", np.int32)
MATERIAL_INDEX = Element("material_index", np.int32)
TRIANGLE_ELEMENT = Element("vertices", np.int32, (3,))
"""Of loop triangles."""
POSE_MATRIX = Element("matrix", np.float32, (4, 4))
"""Of pose bones: armature space, column-major."""
REST_MATRIX = Element("matrix_local", np.float32, (4, 4))
"""Of bones: armature space, column-major."""
POSE_CHANNELS = (
    Element("location", np.float32, (3,)),
    Element("rotation_euler", np.float32, (3,)),
    Element("rotation_quaternion", np.float32, (4,)),
    Element("rotation_axis_angle", np.float32, (4,)),
    Element("scale", np.float32, (3,)),
)
"""Of pose bones: all properties that define a pose; angles in radians."""
KEYFRAME_ELEMENTS = (
    Element("co", np.float32, (2,)),
    Element("handle_left", np.float32, (2,)),
    Element("handle_right", np.float32, (2,)),
    Element("interpolation", np.int32),
    Element("easing", np.int32),
    Element("amplitude", np.float32),
    Element("back", np.float32),
    Element("period", np.float32),
)
"""Of keyframe points: all properties that define the values of an F-curve."""


def read(collection: bpy.types.bpy_prop_collection, element: Element) -> np.ndarray:
    """Read the values of all elements of a collection, (n, *element.shape) of element.dtype."""
    values = element.empty(len(collection))
    collection.foreach_get(element.name, values.reshape(-1))
    return values


def write(collection: bpy.types.bpy_prop_collection, element: Element, values: np.ndarray) -> None:
    """Set the values of all elements of a collection.

    Args:
        collection: n elements.
        element: the property to set.
        values: (n, *element.shape) of element.dtype, contiguous.

    Raises:
        ValueError: the array has another shape or type, or is not contiguous.
    """
    if not _holds(values, element) or len(values) != len(collection):
        raise _mismatch(collection, element, values)
    collection.foreach_set(element.name, values.reshape(-1))


class Reader:
    """Reads a property of a collection into the same memory each time.

    Attributes:
        element: the property.
        values: (n, *element.shape) of element.dtype, as they were read last.
    """

    def __init__(self, element: Element, values: np.ndarray):
        """Prepare to read a property.

        Args:
            element: the property.
            values: memory to read into, (n, *element.shape) of element.dtype, contiguous.

        Raises:
            ValueError: the array has another shape or type, or is not contiguous.
        """
        if not _holds(values, element):
            raise _mismatch("the memory to read into", element, values)
        self.element, self.values, self._flat = element, values, values.reshape(-1)

    def read(self, collection: bpy.types.bpy_prop_collection) -> None:
        """Read the values of a collection into `values`.

        A collection with fewer than n elements is not noticed: counting bones takes Blender as long as reading them.

        Raises:
            ValueError: the collection has more than n elements.
        """
        try:
            collection.foreach_get(self.element.name, self._flat)
        except (RuntimeError, TypeError) as error:
            raise _mismatch(collection, self.element, self.values) from error


def write_pixels(preview: bpy.types.ImagePreview, pixels: np.ndarray) -> None:
    """Write the pixels of a preview image.

    Args:
        preview: the preview, of the size of the pixels.
        pixels: (height, width, 4) float32, linear RGBA, rows from the bottom.

    Raises:
        ValueError: the array has another shape or type.
    """
    width, height = preview.image_size
    if pixels.shape != (height, width, 4) or pixels.dtype != np.float32:
        raise ValueError(
            f"The preview takes pixels ({height}, {width}, 4) float32, the array is {pixels.shape} {pixels.dtype}."
        )
    preview.image_pixels_float.foreach_set(pixels.ravel())


def _holds(values: np.ndarray, element: Element) -> bool:
    return values.dtype == element.dtype and values.shape[1:] == element.shape and values.flags.c_contiguous


def _mismatch(collection: object, element: Element, values: np.ndarray) -> ValueError:
    expected = f"{element.shape} {np.dtype(element.dtype)} each"
    order = "" if values.flags.c_contiguous else ", not contiguous"
    actual = f"{values.shape} {values.dtype}{order}"
    return ValueError(f"'{element.name}' of {collection} is {expected}, the array is {actual}.")
