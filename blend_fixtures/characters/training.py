# SPDX-License-Identifier: GPL-3.0-or-later
"""Trains many recordings in one process, in the Python that has torch: most of a short training is the start of that.

Run as a module it reads the arguments of a training from each line of stdin, as JSON, until stdin ends. It answers each
with a line of JSON: the exit status.
"""

import contextlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Self

from fdda_addon.training.process import trainer_command

MODULE = "blend_fixtures.characters.training"
SMALL = ("--hidden", "32", "32", "--batch-size", "16")
"""Options for a recording of few poses: small networks and many steps."""


class Trainings:
    """Trainings one after the other, in a process beside this one; all are done when the `with` block is left."""

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
        self._under_way: list[list[str]] = []

    def add(self, recording: Path, model: Path, *options: object) -> None:
        """Train a model when those before are done; does not wait. `options` are those of `python -m trainer`."""
        arguments = [str(argument) for argument in (recording, model, *options)]
        self._under_way.append(arguments)
        self._process.stdin.write(json.dumps(arguments) + "\n")
        self._process.stdin.flush()

    def wait(self) -> None:
        """Wait until all trainings are done.

        Raises:
            RuntimeError: one failed; the text is what the process wrote.
        """
        while self._under_way:
            arguments = self._under_way.pop(0)
            answer = self._process.stdout.readline()
            if not answer or json.loads(answer):
                self._errors.seek(0)
                raise RuntimeError(f"train {' '.join(arguments)} failed: {self._errors.read()}")

    def close(self) -> None:
        """End the process, whatever it does."""
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
    """Train what stdin asks for."""
    # Loaded before the first line comes: meanwhile the first character is recorded.
    import trainer.training  # noqa: F401
    from trainer.__main__ import main as train

    answers = sys.stdout
    for line in sys.stdin:
        with contextlib.redirect_stdout(sys.stderr):
            try:
                status = train(json.loads(line))
            except SystemExit as error:  # wrong usage
                status = error.code
        print(json.dumps(status), file=answers, flush=True)


if __name__ == "__main__":
    main()
