# SPDX-License-Identifier: GPL-3.0-or-later
"""Appends evaluated poses to a recording in batches, in a thread while Blender evaluates the next poses."""

from concurrent.futures import Future, ThreadPoolExecutor
from typing import Self

import numpy as np

from ..core.recording.writer import RecordingWriter
from ..rig.pose_setter import DIRECT_POSE_SETTER, PoseSetter
from ..rig.reading import PoseEvaluator

BATCH_BYTES = 6 << 20
BATCH_POSES = 250
"""Largest size of a batch. Batches are small, because a crash loses those that are not written yet."""


class PoseAppender:
    """Context manager that appends the poses of one mesh to its recording.

    Attributes:
        pose_count: number of evaluated poses, including the poses that the recording had before. The recording contains
            all of them when the `with` block ends, even if it ends because a generator was closed.
    """

    def __init__(
        self,
        evaluator: PoseEvaluator,
        writer: RecordingWriter,
        vertex_count: int,
        pose_setter: PoseSetter = DIRECT_POSE_SETTER,
    ) -> None:
        self._evaluator, self._writer, self._pose_setter = evaluator, writer, pose_setter
        self.pose_count = writer.complete
        self._batch_size = max(1, min(BATCH_POSES, BATCH_BYTES // (vertex_count * 12)))
        self._pool = ThreadPoolExecutor(max_workers=1)
        self._pending_append: Future | None = None
        self._batch: list[tuple] = []

    def append_current_pose(self) -> None:
        """Evaluate the current pose, and append its batch when the batch is full."""
        self._batch.append((*self._evaluator.evaluate(), self._pose_setter.is_at_rest))
        self.pose_count += 1
        # A pose that took seconds to settle is written at once.
        if len(self._batch) == self._batch_size or self._pose_setter.is_settling:
            self._wait_for_append()
            self._pending_append = self._pool.submit(self._append, self._batch)
            self._batch = []

    def _wait_for_append(self) -> None:
        if self._pending_append is not None:
            self._pending_append.result()

    def _append(self, batch: list[tuple]) -> None:
        *arrays, are_at_rest = (np.stack(arrays) for arrays in zip(*batch, strict=True))
        unsettled_indices = np.flatnonzero(~are_at_rest).tolist()
        self._writer.append(*arrays, *([unsettled_indices] if unsettled_indices else []))

    def flush(self) -> None:
        """Append all evaluated poses."""
        self._wait_for_append()
        if self._batch:
            self._append(self._batch)
            self._batch = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, exception_type: type | None, *_: object) -> None:
        try:
            if exception_type is None or exception_type is GeneratorExit:
                self.flush()
        finally:
            self._pool.shutdown()
