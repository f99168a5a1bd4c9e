# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads and writes properties of RNA collections as numpy arrays.

`foreach_get` and `foreach_set` also accept an array of another type, which is a hundred times slower, and sometimes an
array that is too long. The functions of this module raise an error in both cases.
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

    def empty(self, count: int) -> np.ndarray:
        """Allocate an uninitialized array (count, *shape) of dtype."""
        return np.empty((count, *self.shape), self.dtype)


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


def read(collection: bpy.types.bpy_prop_collection, element: ElementProperty) -> np.ndarray:
    """Read the values of all elements of a collection, (n, *element.shape) of element.dtype."""
    values = element.empty(len(collection))
    collection.foreach_get(element.name, values.reshape(-1))
    return values


def write(collection: bpy.types.bpy_prop_collection, element: ElementProperty, values: np.ndarray) -> None:
    """Set the values of all elements of a collection.

    Args:
        collection: n elements.
        values: (n, *element.shape) of element.dtype, contiguous.

    Raises:
        ValueError: the array has another shape or type, or is not contiguous.
    """
    if not _has_layout(values, element) or len(values) != len(collection):
        raise _layout_error(collection, element, values)
    collection.foreach_set(element.name, values.reshape(-1))


class PropertyReader:
    """Reads a property of a collection into an array that it reuses.

    Attributes:
        element: the property.
        values: (n, *element.shape) of element.dtype, as of the last call of `read`.
    """

    def __init__(self, element: ElementProperty, values: np.ndarray):
        """Prepare to read a property.

        Args:
            values: the array to read into, (n, *element.shape) of element.dtype, contiguous.

        Raises:
            ValueError: the array has another shape or type, or is not contiguous.
        """
        if not _has_layout(values, element):
            raise _layout_error("the array to read into", element, values)
        self.element, self.values, self._flat_values = element, values, values.reshape(-1)

    def read(self, collection: bpy.types.bpy_prop_collection) -> None:
        """Read the values of a collection into `values`.

        A collection with fewer than n elements raises no error, because counting bones takes as long as reading them.

        Raises:
            ValueError: the collection has more than n elements.
        """
        try:
            collection.foreach_get(self.element.name, self._flat_values)
        except (RuntimeError, TypeError) as error:
            raise _layout_error(collection, self.element, self.values) from error


def write_pixels(preview: bpy.types.ImagePreview, pixels: np.ndarray) -> None:
    """Write the pixels of a preview image.

    Args:
        preview: the preview; its size must be that of the pixels.
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


def _has_layout(values: np.ndarray, element: ElementProperty) -> bool:
    """Return whether an array has the dtype and shape of a property, and is contiguous."""
    return values.dtype == element.dtype and values.shape[1:] == element.shape and values.flags.c_contiguous


def _layout_error(collection: object, element: ElementProperty, values: np.ndarray) -> ValueError:
    expected_layout = f"{element.shape} {np.dtype(element.dtype)} each"
    contiguity = "" if values.flags.c_contiguous else ", not contiguous"
    actual_layout = f"{values.shape} {values.dtype}{contiguity}"
    return ValueError(f"'{element.name}' of {collection} is {expected_layout}, the array is {actual_layout}.")
