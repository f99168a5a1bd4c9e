# SPDX-License-Identifier: GPL-3.0-or-later
"""Evaluates poses and appends them to a recording in batches; while one is written, Blender evaluates the next."""

import contextlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Self

import numpy as np

from ..core.recording.extension import RecordingExtension
from ..core.recording.writer import RecordingWriter
from ..core.skinning import LinearSkinning
from ..rig.pose_setter import DIRECT_POSE_SETTER, PoseSetter
from ..rig.reading import PoseEvaluator

BATCH_BYTES = 6 << 20
BATCH_POSES = 250
"""Poses go to the disk in batches of at most this size, so that an interruption loses little."""


class Appender:
    """Appends the poses of one mesh to its recording; use as a context manager.

    Attributes:
        done: how many poses were evaluated, those that the recording had before included. They are in the recording
            when the block has ended, also when it ends because a generator is closed.
    """

    def __init__(
        self,
        evaluator: PoseEvaluator,
        skinning: LinearSkinning,
        writer: RecordingWriter | RecordingExtension,
        pose_setter: PoseSetter = DIRECT_POSE_SETTER,
    ) -> None:
        self._pose_setter = pose_setter
        self.done = writer.complete
        self._evaluator, self._skinning, self._writer = evaluator, skinning, writer
        self._size = max(1, min(BATCH_POSES, BATCH_BYTES // (skinning.rig.vertex_count * 12)))
        self._pool = ThreadPoolExecutor(max_workers=1)
        self._previous: Future | None = None
        self._batch: list[tuple] = []

    def add(self) -> None:
        """Evaluate the pose that is set now, and append it with its batch.

        Raises:
            FDDAError: a pose before it could not be appended.
        """
        self._batch.append((*self._evaluator.evaluate(), self._pose_setter.is_at_rest))
        self.done += 1
        # What took seconds to settle is not lost.
        if len(self._batch) == self._size or self._pose_setter.settler:
            self._wait()
            self._previous = self._pool.submit(self._append, self._batch)
            self._batch = []

    def _wait(self) -> None:
        if self._previous is not None:
            self._previous.result()

    def _append(self, batch: list[tuple]) -> None:
        pose_matrices, positions, controls, are_at_rest = (np.stack(arrays) for arrays in zip(*batch, strict=True))
        unsettled = np.flatnonzero(~are_at_rest).tolist()
        arrays = pose_matrices, self._skinning.local_residuals(pose_matrices, positions), controls
        self._writer.append(*arrays, *([unsettled] if unsettled else []))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type | None, *_: object) -> None:
        try:
            if kind is None or kind is GeneratorExit:
                self._wait()
                if self._batch:
                    self._append(self._batch)
        finally:
            self._pool.shutdown()


def append_poses(poses: Iterator[object], appenders: list[Appender]) -> Iterator[int]:
    """Add the pose that each iteration sets to the recordings that lack it; yields how many all of them have.

    When it is closed, the poses that were evaluated are appended.

    Args:
        poses: sets the poses from the one of number `done` of the appender that has fewest on, one an iteration.
        appenders: of the meshes that follow the poses.
    """
    with contextlib.ExitStack() as stack:
        for appender in appenders:
            stack.enter_context(appender)
        number = min(appender.done for appender in appenders)
        for _ in poses:
            for appender in appenders:
                if appender.done == number:
                    appender.add()
            number += 1
            yield number
