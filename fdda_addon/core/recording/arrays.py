# SPDX-License-Identifier: GPL-3.0-or-later
"""Arrays of a recording: untrusted `.npy` files, which are checked before they are memory-mapped."""

import math
import os
import tokenize
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..errors import RecordingError, os_error_text
from ..input_file import open_input
from ..skinning import are_invertible

NPY_HEADER_ERRORS = (TypeError, SyntaxError, RecursionError, MemoryError, tokenize.TokenError)
"""Errors beside ValueError that numpy raises for a damaged header of a `.npy` file."""
MAX_VALUE = 1e12
"""Largest absolute value of an element; sums of squares of larger values may overflow."""
CHECK_CHUNK_BYTES = 64 << 20
"""Size of the chunks in which arrays are checked for invalid values."""
POSE_MATRICES = "pose_matrices"
SINGULAR_JOINTS = "joints that have shrunk to nothing"
_VALUE_CHECKS = {
    "values that are not numbers": np.isfinite,
    "values beyond all bounds": lambda values: np.abs(values) <= MAX_VALUE,
    SINGULAR_JOINTS: are_invertible,
}
"""Checks of pose arrays, by the words of their errors."""


def array_shapes(
    poses: int, joints: int, vertices: int, influences: int, faces: int = 0, corners: int = 0, controls: int = 0
) -> dict[str, tuple[tuple, type]]:
    """Return shape and dtype of each array of a recording, by name.

    Args:
        poses, joints, vertices: counts.
        influences: number of skin weights of a vertex.
        faces, corners: counts; without faces their arrays are left out.
        controls: count; without controls their array is left out.
    """
    control_arrays = {"controls": ((poses, controls), np.float32)}
    face_arrays = {"face_starts": ((faces,), np.int32), "face_vertices": ((corners,), np.int32)}
    return {
        "rest_positions": ((vertices, 3), np.float32),
        "rest_matrices": ((joints, 4, 4), np.float32),
        "skin_joints": ((vertices, influences), np.int32),
        "skin_weights": ((vertices, influences), np.float32),
        POSE_MATRICES: ((poses, joints, 4, 4), np.float32),
        "residuals": ((poses, vertices, 3), np.float32),
        **(control_arrays if controls else {}),
        **(face_arrays if faces else {}),
    }


ARRAY_NAMES = tuple(array_shapes(1, 1, 1, 1, faces=1, corners=1, controls=1))
"""Names of all arrays of a recording."""
STREAMED_ARRAY_NAMES = (POSE_MATRICES, "residuals", "controls")
"""Names of the arrays with one row per pose."""


def streamed_arrays(
    pose_matrices: np.ndarray, residuals: np.ndarray, controls: np.ndarray | None, count: int
) -> dict[str, np.ndarray]:
    """Return the arrays with one row per pose, by name; `count` is the number of controls."""
    control_arrays = {"controls": controls} if count else {}
    return {POSE_MATRICES: pose_matrices, "residuals": residuals, **control_arrays}


def open_array(path: Path, shape: tuple, dtype: type, rows: int | None = None) -> np.ndarray:
    """Memory-map an array after its header and size are checked against the index.

    Args:
        path: the file.
        shape, dtype: expected; arrays in `STREAMED_ARRAY_NAMES` may have more rows.
        rows: number of rows that must exist and are mapped, at least one; all of `shape` by default.

    Raises:
        RecordingError: it is missing, not a regular file, truncated, or of another shape or dtype.
    """
    try:
        with open_input(path, follow_links=False) as file:
            found_shape, found_dtype = read_array_header(file)
            # An interrupted extension may leave more poses than the index counts.
            longer = path.stem in STREAMED_ARRAY_NAMES and found_shape[:1] > shape[:1] and found_shape[1:] == shape[1:]
            if not (found_shape == shape or longer) or found_dtype != np.dtype(dtype):
                raise ValueError(f"it holds {found_shape} {found_dtype}, not {shape} {np.dtype(dtype)}")
            start, mapped = file.tell(), shape if rows is None else (rows, *shape[1:])
            # math.prod, because the counts are untrusted and integers of numpy overflow.
            expected = start + math.prod(found_shape if rows is None else mapped) * np.dtype(dtype).itemsize
            size = file.seek(0, os.SEEK_END)
            if size < expected:
                raise ValueError(f"it is truncated: {size} of {expected} bytes")
            return np.memmap(file, dtype, "r", start, mapped)
    except OSError as error:
        raise RecordingError(f"'{path}' cannot be used: {os_error_text(error)}; record again.") from error
    except ValueError as error:
        raise RecordingError(f"'{path}' cannot be used: {error}; record again.") from error
    except NPY_HEADER_ERRORS as error:
        raise RecordingError(f"'{path}' cannot be used: its header is damaged; record again.") from error


def read_array_header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype]:
    """Read the header of a `.npy` file up to the first element; returns shape and dtype.

    Raises:
        ValueError: it is no such header, of another version, or of elements in another order.
        NPY_HEADER_ERRORS: it is damaged.
    """
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError("its npy version is not 1.0")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    if fortran:
        raise ValueError("its elements are in another order")
    return shape, dtype


def find_invalid_pose(name: str, array: np.ndarray) -> tuple[int, str] | None:
    """Find the first pose with values that cannot be trained on.

    Args:
        name: of the array.
        array: (n, ...) of n poses.

    Returns:
        Its index and words for the values; None where all poses are valid.
    """
    step = max(1, CHECK_CHUNK_BYTES // max(1, array[:1].nbytes))
    for start in range(0, len(array), step):
        part = np.asarray(array[start : start + step])
        for words, check in _VALUE_CHECKS.items():
            if words != SINGULAR_JOINTS or name == POSE_MATRICES:
                good = check(part)
                if not good.all():
                    return start + int(np.flatnonzero(~good.reshape(len(part), -1).all(axis=1))[0]), words
    return None
