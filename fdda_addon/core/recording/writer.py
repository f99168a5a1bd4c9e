# SPDX-License-Identifier: GPL-3.0-or-later
"""Writing of a recording (docs/formats.md), which can be interrupted at any moment and resumed or extended later."""

import contextlib
import io
import json
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import BusyError, OutputError, RecordingError, os_error_text
from ..files.input_file import open_input
from ..files.open_files import remove_file
from ..rig import Rig, read_unit, rest_matrices_match, unit_to_json
from ..wording import format_count
from .arrays import (
    POSE_MATRICES,
    POSITIONS,
    STREAMED_ARRAY_NAMES,
    array_header,
    check_pose_values,
    open_array,
    rig_array_shapes,
)
from .folder import RECORDING_FILES, check_folder, remove_recording_files, remove_temporary_files
from .index import (
    BONES_NAME,
    FORMAT,
    INDEX_NAME,
    REFINED,
    VERSION,
    RecordingInfo,
    Source,
    find_different_keys,
    read_index,
    write_json,
)
from .lock import RecordingLock
from .reader import Recording

MUTABLE_KEYS = ("complete", "unsettled", "repeatability_mm")
"""Keys of the index that change while poses are appended."""


class RecordingWriter:
    """Context manager that writes a recording pose by pose.

    Every `append` first writes the arrays to the disk, then the number of complete poses. An interruption therefore
    leaves a recording that can be resumed and has no partial pose. Arrays are written instead of memory-mapped, so that
    a full disk raises an error. A new recording that fails before its first complete pose is removed.
    """

    def __init__(
        self,
        path: Path,
        rig: Rig,
        info: RecordingInfo,
        resume: bool = False,
        overwrite: bool = False,
    ):
        """Start or resume a recording.

        Args:
            path: the folder, which is created where it is missing.
            rig: rig to record.
            info: origin and number of poses of the recording; `complete` is ignored.
            resume: continue the recording at `path`.
            overwrite: remove the recording at `path` first.

        Raises:
            RecordingError: the folder has a recording and neither `resume` nor `overwrite` is set, that recording has
                another rig or other settings, or another process writes it.
            OutputError: the folder cannot be written.
        """
        self.path, self.rig, self.info = path, rig, info
        self.complete = 0
        self.unsettled: list[int] = []
        self.repeatability_mm: float | None = None
        self._files: dict[str, io.BufferedRandom] = {}
        self._is_new = False
        self._new_folders = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
        check_folder(path, resume, overwrite)
        self._lock = RecordingLock(path)
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._lock.acquire()
            # Check again: another process may have recorded before the lock was acquired.
            check_folder(path, resume, overwrite)
            if overwrite:
                remove_recording_files(path)
            self._is_new = not os.path.exists(path / INDEX_NAME)
            remove_temporary_files(path)
            if not self._is_new:
                self._read_previous(read_index(path))
            if self._is_new:
                write_json(path / BONES_NAME, info.bones.to_json())
            # The index is written first: a folder with arrays but no index can neither be resumed nor used again.
            self._write_index()
            self._open_arrays()
        except BaseException as error:
            self._close()
            self._remove_if_empty()
            self._lock.release()
            if isinstance(error, OSError):
                raise self._write_error(error) from error
            raise

    @property
    def note(self) -> str:
        """Return a sentence for the user about the drive; may be empty."""
        return self._lock.note

    def _read_previous(self, previous: dict) -> None:
        """Read the state of the recording at `path` from its index, and check that it can be continued."""
        self.complete, self.unsettled = previous["complete"], list(previous.get("unsettled", ()))
        self.repeatability_mm = previous.get("repeatability_mm")
        # The scale of an object may be animated; no array depends on it.
        self.rig = replace(self.rig, metres_per_unit=read_unit(previous))
        # Convert it to JSON text and back, so that it equals what is read from a file.
        current = json.loads(json.dumps(self._index() | {"bones": self.info.bones.to_json()}))
        if different_keys := [
            key for key in find_different_keys(previous, current) if key.partition(".")[0] not in MUTABLE_KEYS
        ]:
            raise RecordingError(
                f"Cannot resume '{self.path}': it was recorded differently ({', '.join(different_keys)}); "
                "record with the same rig and options, or into another folder."
            )

    def _open_arrays(self) -> None:
        for name, (shape, dtype) in rig_array_shapes(self.rig, self.info.poses).items():
            path = self.path / f"{name}.npy"
            if not self.complete:
                # The path may be a symbolic link, and the file that it points to must not be overwritten.
                remove_file(path)
            if name not in STREAMED_ARRAY_NAMES:
                array = getattr(self.rig, name).astype(dtype)
                if not self.complete:
                    np.save(path, array, allow_pickle=False)
                else:
                    recorded = open_array(path, shape, dtype)
                    is_matrix, rig = name == "rest_matrices", self.rig
                    if not (rest_matrices_match(recorded, rig) if is_matrix else np.array_equal(recorded, array)):
                        raise RecordingError(
                            f"Cannot resume '{self.path}': '{path.name}' is not of this rig; remove the recording and "
                            "record again."
                        )
                continue
            header = array_header(shape, dtype)
            row_bytes = math.prod(shape[1:]) * np.dtype(dtype).itemsize
            end_offset = len(header) + shape[0] * row_bytes
            if self.complete and open_array(path, (self.complete, *shape[1:]), dtype).offset != len(header):
                raise RecordingError(f"'{path}' has no room for {shape[0]} poses; record again.")
            self._files[name] = file = open_input(path, "r+b" if self.complete else "x+b", follow_links=False)
            # The file is never shorter than its header says.
            file.truncate(max(end_offset, file.seek(0, os.SEEK_END)))
            file.seek(0)
            file.write(header)
            # Windows does not shorten a file that is mapped. What is beyond the end is ignored, too.
            with contextlib.suppress(PermissionError):
                file.truncate(end_offset)
            file.seek(len(header) + self.complete * row_bytes)
            # Allocate the space of all poses now, so that a full disk is found before any pose is evaluated.
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, end_offset)

    def _index(self) -> dict:
        info, face_count = self.info, len(self.rig.face_starts)
        return {
            "format": FORMAT,
            "version": VERSION,
            "poses": info.poses,
            "complete": self.complete,
            "influences": int(self.rig.skin_joints.shape[1]),
            **({"faces": face_count, "corners": len(self.rig.face_vertices)} if face_count else {}),
            "units": {"length": "m", "angle": "rad"},
            **unit_to_json(self.rig.metres_per_unit),
            "blender": info.blender,
            "rig": {"file": info.rig_file},
            "meshes": [mesh.to_json() for mesh in self.rig.meshes],
            "joints": [joint.to_json() for joint in self.rig.joints],
            "controls": [control.to_json() for control in self.rig.controls],
            **({"alone": info.alone.to_json()} if info.alone else {}),
            **({"target": info.target.to_json()} if info.target else {}),
            **({"unsettled": self.unsettled} if self.unsettled else {}),
            **({} if self.repeatability_mm is None else {"repeatability_mm": self.repeatability_mm}),
            "sampling": info.sampling.to_json(),
        }

    def _write_index(self) -> None:
        """Write the index; raise OSError, which `_write_error` converts."""
        write_json(self.path / INDEX_NAME, self._index())

    def append(
        self,
        pose_matrices: np.ndarray,
        positions: np.ndarray,
        controls: np.ndarray | None = None,
        unsettled: Sequence[int] = (),
    ) -> None:
        """Append poses.

        Args:
            pose_matrices: (n, J, 4, 4), mesh-object space, mesh units.
            positions: (n, V, 3), mesh-object space, mesh units.
            controls: (n, C), where the rig has controls.
            unsettled: indices, among the poses appended here, of those in which the target did not come to rest.

        Raises:
            OutputError: the disk is full or was disconnected; earlier poses stay complete.
            RecordingError: a value is not finite.
        """
        arrays = {POSE_MATRICES: pose_matrices, POSITIONS: positions}
        if self.rig.controls:
            arrays["controls"] = controls
        check_pose_values(arrays, self.complete, self.rig.joint_names, self.info.alone_poses)
        previous_counts = self.complete, self.unsettled
        try:
            for name, array in arrays.items():
                self._files[name].write(np.ascontiguousarray(array, np.float32).data)
                self._files[name].flush()
                os.fsync(self._files[name].fileno())
            self.unsettled = [*self.unsettled, *(self.complete + index for index in unsettled)]
            self.complete += len(pose_matrices)
            self._write_index()
        except OSError as error:
            self.complete, self.unsettled = previous_counts
            raise self._write_error(error) from error

    def set_repeatability(self, repeatability_mm: float) -> None:
        """Write the repeatability of the target (`RecordingInfo`) to the index.

        Raises:
            OutputError: the disk is full or was disconnected.
        """
        self.repeatability_mm = repeatability_mm
        try:
            self._write_index()
        except OSError as error:
            raise self._write_error(error) from error

    def _write_error(self, error: OSError) -> OutputError:
        advice = "make room or choose another folder"
        if self.complete:
            advice = (
                f"{self.complete} of {self.info.poses} poses are complete; make room and run the command again, "
                "`record` with --resume"
            )
        return OutputError(f"Cannot write the recording '{self.path}': {os_error_text(error)}; {advice}.")

    def __enter__(self) -> "RecordingWriter":
        return self

    def __exit__(self, kind: type | None, *_: object) -> None:
        self._close()
        if kind is not None:
            self._remove_if_empty()
        self._lock.release()

    def _close(self) -> None:
        for file in self._files.values():
            # On a full disk, closing tries the failed writes again; `append` has already reported their failure.
            with contextlib.suppress(OSError):
                file.close()

    def _remove_if_empty(self) -> None:
        """Remove a new recording without poses, and the folders that were created for it."""
        if not self._is_new or self.complete or not self._lock.is_held:
            return
        for name in (INDEX_NAME, *RECORDING_FILES):
            with contextlib.suppress(OSError):
                remove_file(self.path / name)
        self._lock.release()
        for folder in self._new_folders:
            with contextlib.suppress(OSError):
                folder.rmdir()


class RecordingExtension(RecordingWriter):
    """Writer of further poses, which its index counts when they are complete.

    The arrays have the rows of all planned poses from the start. An interruption therefore leaves a complete recording,
    which has the poses of all calls of `append` that returned.
    """

    def __init__(self, recording: Recording, poses: int, model_name: str):
        """Open the files of a recording.

        Args:
            poses: number of poses to append.
            model_name: file name of the model that the poses refine.
        """
        self._recorded_count, self._model_name = recording.info.poses, model_name
        super().__init__(
            recording.path, recording.rig, replace(recording.info, poses=recording.info.poses + poses), resume=True
        )

    def _read_previous(self, previous: dict) -> None:
        """Check that no other process has changed the recording since it was read."""
        self.complete, self.unsettled = self._recorded_count, list(self.info.unsettled)
        if previous["poses"] != self.complete:
            raise BusyError(
                f"The recording '{self.path}' had {format_count(self.complete, 'pose')} when it was read and has "
                f"{previous['poses']} now: another process added to it; try again."
            )

    def _index(self) -> dict:
        sampling, count = self.info.sampling, self.complete - self._recorded_count
        added_sources = (Source(REFINED, count, self._model_name),) if count else ()
        sampling = replace(sampling, sources=(*sampling.sources, *added_sources))
        return super()._index() | {"poses": self.complete, "sampling": sampling.to_json()}

    def _write_error(self, error: OSError) -> OutputError:
        return OutputError(
            f"Cannot add poses to the recording '{self.path}': {os_error_text(error)}; it holds {self.complete} "
            "poses and can be trained on as it is."
        )
