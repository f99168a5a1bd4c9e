# SPDX-License-Identifier: GPL-3.0-or-later
"""Appending of refined poses to a complete recording, which stays complete throughout (docs/formats.md)."""

import math
import os
from dataclasses import asdict

import numpy as np

from ..errors import BusyError, OutputError, RecordingError, os_error_text
from ..files.input_file import open_input
from ..sentences.counts import format_count
from .arrays import STREAMED_ARRAY_NAMES, array_header, array_shapes, check_pose_values, streamed_arrays
from .index import REFINED, Source, read_index, write_index
from .lock import RecordingLock
from .reader import Recording


class RecordingExtension:
    """Context manager that appends poses to a recording.

    `append` writes the rows first, then the headers of the arrays, and the index last. An interruption therefore leaves
    a complete recording, which has the poses of all calls of `append` that returned.
    """

    def __init__(self, recording: Recording, model_name: str, added_count: int = 0):
        """Args:
            recording: a complete recording.
            model_name: file name of the model that the poses refine.
            added_count: number of poses at the end of the recording that were already added for this model.

        Raises:
            RecordingError: another process writes the recording.
            OutputError: the files cannot be opened for writing.
        """
        self.path = recording.path
        self.complete = len(recording.pose_matrices)
        self._first_added, self._has_added_poses = self.complete - added_count, added_count > 0
        self._model_name = model_name
        self._files = {}
        self._lock = RecordingLock(self.path)
        try:
            self._lock.acquire()
            self._index = self._read_index()
            index = self._index
            shapes = array_shapes(
                *(0, len(index["joints"]), index["vertices"], index["influences"]), controls=len(index["controls"])
            )
            self._shapes = {name: shapes[name] for name in STREAMED_ARRAY_NAMES if name in shapes}
            for array_name in self._shapes:
                self._files[array_name] = open_input(self.path / f"{array_name}.npy", "r+b", follow_links=False)
        except OSError as error:
            self._close()
            raise self._write_error(error) from error
        except RecordingError:
            self._close()
            raise

    def _read_index(self) -> dict:
        """Read the index again while the lock is held, and check that no other process has changed the recording."""
        index = read_index(self.path)
        if index["poses"] != self.complete:
            raise BusyError(
                f"The recording '{self.path}' had {format_count(self.complete, 'pose')} when it was read and has "
                f"{index['poses']} now: another process added to it; try again."
            )
        return index

    def append(self, pose_matrices: np.ndarray, positions: np.ndarray, controls: np.ndarray | None = None) -> None:
        """Append poses.

        Args:
            pose_matrices: (n, J, 4, 4), mesh-object space, mesh units.
            positions: (n, V, 3), mesh-object space, mesh units.
            controls: (n, C), where the rig has controls.

        Raises:
            OutputError: the disk is full or was disconnected; earlier poses stay complete.
            RecordingError: a value is not finite.
        """
        arrays = streamed_arrays(pose_matrices, positions, controls, len(self._index["controls"]))
        check_pose_values(arrays, self.complete, [joint["name"] for joint in self._index["joints"]])
        previous_count = self.complete
        new_count = previous_count + len(pose_matrices)
        try:
            for name, array in arrays.items():
                self._write_rows(name, array)
            for name in arrays:
                self._write_header(name, new_count)
            self.complete = new_count
            self._write_index()
        except OSError as error:
            self.complete = previous_count
            raise self._write_error(error) from error

    def _write_rows(self, name: str, array: np.ndarray) -> None:
        shape, dtype = self._shapes[name]
        row_bytes = math.prod(shape[1:]) * np.dtype(dtype).itemsize
        file = self._files[name]
        file.seek(len(self._header(name, self.complete)) + self.complete * row_bytes)
        file.write(np.ascontiguousarray(array, dtype).data)
        file.flush()
        os.fsync(file.fileno())

    def _write_header(self, name: str, poses: int) -> None:
        header, file = self._header(name, poses), self._files[name]
        if len(header) != len(self._header(name, self._first_added)):
            raise RecordingError(f"'{self.path / name}.npy' has no room for {poses} poses; record again.")
        file.seek(0)
        file.write(header)
        file.flush()
        os.fsync(file.fileno())

    def _header(self, name: str, poses: int) -> bytes:
        shape, dtype = self._shapes[name]
        return array_header((poses, *shape[1:]), dtype)

    def _write_index(self) -> None:
        source = Source(REFINED, self.complete - self._first_added, self._model_name)
        sources_before = self._index["sampling"]["sources"]
        sources = [*(sources_before[:-1] if self._has_added_poses else sources_before), asdict(source)]
        sampling = {**self._index["sampling"], "sources": sources}
        index = {**self._index, "poses": self.complete, "complete": self.complete, "sampling": sampling}
        write_index(self.path, index)

    def _write_error(self, error: OSError) -> OutputError:
        return OutputError(
            f"Cannot add poses to the recording '{self.path}': {os_error_text(error)}; it holds {self.complete} "
            "poses and can be trained on as it is."
        )

    def __enter__(self) -> "RecordingExtension":
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def _close(self) -> None:
        for file in self._files.values():
            file.close()
        self._lock.release()
