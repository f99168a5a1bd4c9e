# SPDX-License-Identifier: GPL-3.0-or-later
"""Training of many recordings in one process: starting PyTorch takes longer than a short training.

As a program, this module runs in the Python that has PyTorch. It reads the arguments of one training from each line of
stdin, as JSON, until stdin ends. For each training it prints a line of JSON: the exit status.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Self

from fdda_addon.training.process import trainer_command

MODULE = "blend_fixtures.characters.training"
SMALL = ("--hidden", "32", "32", "--batch-size", "16")
"""Options of the trainer for a recording of few poses: small networks and small batches."""


class Trainings:
    """A process that trains one model after another. Leaving the `with` block waits until all are trained."""

    def __init__(self):
        command, environment = trainer_command([], module=MODULE)
        self._errors = tempfile.TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115 - `close` closes it
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env=environment,
            text=True,
            encoding="utf-8",
        )
        self._pending: list[tuple[list[str], int]] = []
        """Arguments of each training that has not ended, and the size of `_errors` when it was added."""

    def add(self, recording: Path, model: Path, *options: object) -> None:
        """Add a training that starts when those before it have ended, and return at once."""
        arguments = [str(argument) for argument in (recording, model, *options)]
        self._pending.append((arguments, os.fstat(self._errors.fileno()).st_size))
        self._process.stdin.write(json.dumps(arguments) + "\n")
        self._process.stdin.flush()

    def wait(self) -> None:
        """Wait until all trainings have ended.

        Raises:
            RuntimeError: a training failed; the message contains the errors of the process since then.
        """
        while self._pending:
            arguments, error_start = self._pending.pop(0)
            status_line = self._process.stdout.readline()
            if not status_line or json.loads(status_line):
                self._errors.seek(error_start)
                raise RuntimeError(f"train {' '.join(arguments)} failed: {self._errors.read()}")

    def close(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.communicate()
        self._errors.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type | None, *_: object) -> None:
        try:
            if kind is None:
                self.wait()
        finally:
            self.close()


def main() -> None:
    """Run the trainings whose arguments stdin lists."""
    # This import takes seconds. It runs while the caller records the first character.
    import trainer.train  # noqa: F401
    from trainer.__main__ import main as train

    status_output = sys.stdout
    for line in sys.stdin:
        with contextlib.redirect_stdout(sys.stderr):
            try:
                status = train(json.loads(line))
            except SystemExit as error:  # raised by argparse
                status = error.code
        print(json.dumps(status), file=status_output, flush=True)


if __name__ == "__main__":
    main()
