# SPDX-License-Identifier: GPL-3.0-or-later
"""The one border between numpy arrays and RNA collections: what Blender keeps for each element, in and out.

Blender itself takes an array of another type, only a hundred times slower, and in places one that is too long; here
both are errors.
"""

from dataclasses import dataclass

import bpy
import numpy as np


@dataclass(frozen=True)
class Element:
    """A property of the elements of a collection.

    Attributes:
        name: of the RNA property.
        dtype: that Blender keeps it in, so that it is copied as it is.
        shape: of one element's values; () for one number.
    """

    name: str
    dtype: type[np.generic]
    shape: tuple[int, ...] = ()

    def empty(self, count: int) -> np.ndarray:
        """Memory for (count, *shape) values of dtype."""
        return np.empty((count, *self.shape), self.dtype)


COORDINATE = Element("co", np.float32, (3,))
"""Of vertices and of the points of shape keys; the object's space."""
VECTOR = Element("vector", np.float32, (3,))
"""Of an attribute of vectors, and of vertex normals."""
COLOR = Element("color", np.float32, (4,))
"""Of a colour attribute: linear red, green and blue, and alpha."""
MUTE = Element("mute", np.bool_)
"""Of shape keys."""
LOOP_START = Element("loop_start", np.int32)
VERTEX_INDEX = Element("vertex_index", np.int32)
MATERIAL_INDEX = Element("material_index", np.int32)
TRIANGLE = Element("vertices", np.int32, (3,))
"""Of loop triangles."""
POSE_MATRIX = Element("matrix", np.float32, (4, 4))
"""Of pose bones: armature space, column by column."""
REST_MATRIX = Element("matrix_local", np.float32, (4, 4))
"""Of bones: armature space, column by column."""
POSE_CHANNELS = (
    Element("location", np.float32, (3,)),
    Element("rotation_euler", np.float32, (3,)),
    Element("rotation_quaternion", np.float32, (4,)),
    Element("rotation_axis_angle", np.float32, (4,)),
    Element("scale", np.float32, (3,)),
)
"""Of pose bones: all that a pose sets; angles in radians."""
KEYFRAME = (
    Element("co", np.float32, (2,)),
    Element("handle_left", np.float32, (2,)),
    Element("handle_right", np.float32, (2,)),
    Element("interpolation", np.int32),
    Element("easing", np.int32),
    Element("amplitude", np.float32),
    Element("back", np.float32),
    Element("period", np.float32),
)
"""Of keyframe points: all that the values of a curve follow from."""


def read(collection: bpy.types.bpy_prop_collection, element: Element) -> np.ndarray:
    """Values of all elements of a collection, (n, *element.shape) element.dtype."""
    values = element.empty(len(collection))
    collection.foreach_get(element.name, values.reshape(-1))
    return values


def write(collection: bpy.types.bpy_prop_collection, element: Element, values: np.ndarray) -> None:
    """Set the values of all elements of a collection.

    Args:
        collection: of n elements.
        element: what is set.
        values: (n, *element.shape) element.dtype, contiguous.

    Raises:
        ValueError: they are not that.
    """
    if not _holds(values, element) or len(values) != len(collection):
        raise _mismatch(collection, element, values)
    collection.foreach_set(element.name, values.reshape(-1))


class Reader:
    """Reads a collection again and again into the same memory.

    Attributes:
        element: what is read.
        values: (n, *element.shape) element.dtype, what was read last.
    """

    def __init__(self, element: Element, values: np.ndarray):
        """Args:
        element: what is read.
        values: the memory, (n, *element.shape) element.dtype, contiguous.

        Raises:
            ValueError: it is not that.
        """
        if not _holds(values, element):
            raise _mismatch("the memory to read into", element, values)
        self.element, self.values, self._flat = element, values, values.reshape(-1)

    def read(self, collection: bpy.types.bpy_prop_collection) -> None:
        """Bring `values` up to date.

        They are not counted, for Blender takes as long to count bones as to read them: a collection that may have
        become smaller has to be counted by whoever knows when.

        Raises:
            ValueError: the collection has more than n elements.
        """
        try:
            collection.foreach_get(self.element.name, self._flat)
        except (RuntimeError, TypeError) as error:
            raise _mismatch(collection, self.element, self.values) from error


def write_pixels(preview: bpy.types.ImagePreview, pixels: np.ndarray) -> None:
    """Paint a preview.

    Args:
        preview: of the size that the pixels have.
        pixels: (height, width, 4) float32, rows from the bottom; linear red, green and blue, and alpha.

    Raises:
        ValueError: they are not that.
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
    has = f"{element.shape} {np.dtype(element.dtype)} each"
    order = "" if values.flags.c_contiguous else ", not contiguous"
    return ValueError(f"'{element.name}' of {collection} is {has}, the array is {values.shape} {values.dtype}{order}.")
