# SPDX-License-Identifier: GPL-3.0-or-later
"""Appending of refined poses to a complete recording, which stays complete throughout (docs/formats.md)."""

import json
from dataclasses import replace

from ..errors import BusyError, OutputError, os_error_text
from ..sentences.counts import format_count
from .index import REFINED, Source
from .reader import Recording
from .writer import RecordingWriter


class RecordingExtension(RecordingWriter):
    """Writer of further poses, which its index counts when they are complete.

    The arrays have the rows of all planned poses from the start. An interruption therefore leaves a complete recording,
    which has the poses of all calls of `append` that returned.
    """

    def __init__(self, recording: Recording, poses: int, model_name: str, added_count: int = 0):
        """Open the files of a recording.

        Args:
            recording: a complete recording.
            poses: number of poses to append.
            model_name: file name of the model that the poses refine.
            added_count: number of poses at the end of the recording that were already added for this model.
        """
        self._recorded_count, self._added_count, self._model_name = recording.info.poses, added_count, model_name
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
        sampling, count = self.info.sampling, self.complete - self._recorded_count + self._added_count
        sources = sampling.sources[:-1] if self._added_count else sampling.sources
        added_sources = (Source(REFINED, count, self._model_name),) if count else ()
        sampling = replace(sampling, sources=(*sources, *added_sources))
        return super()._index() | {"poses": self.complete, "sampling": json.loads(json.dumps(sampling.to_json()))}

    def _write_error(self, error: OSError) -> OutputError:
        return OutputError(
            f"Cannot add poses to the recording '{self.path}': {os_error_text(error)}; it holds {self.complete} "
            "poses and can be trained on as it is."
        )
