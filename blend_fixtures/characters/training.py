# SPDX-License-Identifier: GPL-3.0-or-later
"""Trains many recordings in one process, in the Python that has torch: most of a short training is the start of that.

Run as a module it reads a line of JSON for each training from stdin, [RECORDING, MODEL.onnx, EPOCHS], until stdin ends.
"""

import json
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Self

from fdda_addon.training.process import trainer_command

MODULE = "blend_fixtures.characters.training"
HIDDEN, BATCH = (32, 32), 16
"""Small networks and many steps: there are few poses."""


class Trainings:
    """Trainings one after the other, in a process beside this one; all are done when the `with` block is left."""

    def __enter__(self) -> Self:
        command, environment = trainer_command([], module=MODULE)
        self._errors = tempfile.TemporaryFile("w+", encoding="utf-8")
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._errors, env=environment, text=True
        )
        return self

    def add(self, recording: Path, model: Path, epochs: int) -> None:
        """Train a model when those before are done; its report is written beside it."""
        self._process.stdin.write(json.dumps([str(recording), str(model), epochs]) + "\n")
        self._process.stdin.flush()

    def __exit__(self, kind: type | None, *_: object) -> None:
        if kind is not None:
            self._process.terminate()
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        status = self._process.wait()
        self._errors.seek(0)
        text = self._errors.read()
        self._errors.close()
        # What is not read any more is not the reason.
        if status and (kind is None or issubclass(kind, BrokenPipeError)):
            raise RuntimeError(f"the trainings ended with status {status}: {text}")


def main() -> None:
    """Train what stdin asks for."""
    from trainer.announcements import MessageLines
    from trainer.config import TrainingConfig

    # Loaded before the first line comes: meanwhile the first character is recorded.
    from trainer.training import train_model

    for line in sys.stdin:
        recording, model, epochs = json.loads(line)
        config = TrainingConfig(epochs=epochs, hidden=HIDDEN, batch_size=BATCH)
        train_model(Path(recording), Path(model), config, MessageLines())


if __name__ == "__main__":
    main()
