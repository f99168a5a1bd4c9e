# SPDX-License-Identifier: GPL-3.0-or-later
"""Trainings that outlast the Blender that has started them.

What such a training says goes into a file among the add-on's own, by the path of its model. So another file may be
opened and Blender closed, or crash: whoever opens the character again follows the training from its first message, also
where it has ended meanwhile. No file beside a model, which may be anyone's, is trusted to name a process.
"""

import contextlib
import hashlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import BinaryIO, TextIO

from ..core.errors import OutputError, os_error_text
from ..core.output import write_json
from .environment.folder import user_folder
from .environment.subprocesses import popen_options
from .process import Training

POLL_SECONDS = 0.1
_child_processes: dict[int, subprocess.Popen] = {}
"""Processes of this Blender, by their number: somebody has to ask for their status once they have ended."""


class DetachedTraining(Training):
    """A training that goes on when `leave` was called before the block ends; otherwise its process is gone then."""

    loss_advice = "no model was written, train again"

    def __init__(self, arguments: list[str], model: Path):
        """Start the trainer.

        Args:
            arguments: of `python -m trainer`.
            model: the file that it writes; one training of it at a time.

        Raises:
            TrainingError: the interpreter cannot be started.
            OutputError: the folder for what it says cannot be written.
        """
        self._files, self._is_detached = _ProcessFiles(model), False
        super().__init__(arguments)
        _child_processes[self._process.pid] = self._process
        try:
            self._files.write_process_id(self._process.pid)
        except OutputError:
            # Nobody would find it again.
            self.__exit__()
            raise

    def _new_stop_file(self) -> Path:
        self._files.remove()
        return self._files.stop_file

    def _new_errors(self) -> TextIO:
        return self._files.new_errors()

    def _start(self, command: list[str], environment: dict[str, str]) -> subprocess.Popen:
        with self._files.new_messages() as file:
            return subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=self._errors,
                env=environment,
                **popen_options(own_session=True),
            )

    def _read(self) -> None:
        offset, rest = 0, b""
        while not self._is_detached:
            # Asked before reading: what was written before it ended is read.
            is_alive = self._process.poll() is None
            try:
                with self._files.messages.open("rb") as file:
                    file.seek(offset)
                    chunk = file.read()
            except PermissionError:
                # On Windows, while `is_running` of another thread tries the file.
                time.sleep(POLL_SECONDS)
                continue
            offset += len(chunk)
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                self._lines.put(line.decode("utf-8", "replace"))
            if not is_alive and not chunk:
                break
            time.sleep(0 if lines else POLL_SECONDS)
        self._lines.put(None)

    def detach(self) -> None:
        """Let it go on when the block ends."""
        self._is_detached = True
        if self._finalizer is not None:
            self._finalizer.detach()

    def __exit__(self, *error: object) -> None:
        if self._is_detached:
            self._reader.join()
            self._errors.close()
            return
        super().__exit__(*error)
        self._files.remove()


class AttachedTraining(DetachedTraining):
    """A training that was left, followed from its first message."""

    def __init__(self, model: Path):
        """Follow the training of a model; `is_detached` has to be true."""
        self._files, self._is_detached = _ProcessFiles(model), False
        self._stop_file, self._errors = self._files.stop_file, self._files.errors()
        pid = self._files.process_id
        self._process = _child_processes.get(pid) or _ForeignProcess(pid, self._files)
        self._start_reader()


def is_detached(model: Path) -> bool:
    """Whether a training of a model was left and nobody has seen its end yet."""
    return _ProcessFiles(model).process_id > 0


class _ProcessFiles:
    """What is known of the training of a model, on the disk: its process, and what that has said."""

    def __init__(self, model: Path):
        name = hashlib.sha256(os.path.normcase(model.resolve()).encode("utf-8", "surrogateescape")).hexdigest()[:24]
        self._path = user_folder() / "trainings" / f"{name}.json"
        self.messages = self._path.with_suffix(".messages")
        self.stop_file = self._path.with_suffix(".stop")
        self._errors = self._path.with_suffix(".errors")

    def new_messages(self) -> BinaryIO:
        """The file for what a process says, which holds it locked as long as it lives.

        Raises:
            OutputError: it cannot be written.
        """
        file = self._new(self.messages)
        if sys.platform != "win32":
            import fcntl

            with contextlib.suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return file

    def new_errors(self) -> TextIO:
        """The file for what a process writes to stderr; raises as `new_messages`."""
        return io.TextIOWrapper(self._new(self._errors), encoding="utf-8", errors="replace")

    def errors(self) -> TextIO:
        """What a process wrote to stderr."""
        try:
            return self._errors.open(encoding="utf-8", errors="replace")
        except OSError:
            return io.StringIO()

    def _new(self, path: Path) -> BinaryIO:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            return path.open("w+b")
        except OSError as error:
            raise OutputError(f"Cannot write '{path}': {os_error_text(error)}; make room there.") from error

    def write_process_id(self, process_id: int) -> None:
        """Keep the number of the process; raises OutputError."""
        write_json(self._path, {"process": process_id})

    @property
    def process_id(self) -> int:
        """Number of the process, 0 when there is none."""
        try:
            return int(json.loads(self._path.read_text(encoding="utf-8"))["process"]) * self.messages.is_file()
        except (OSError, ValueError, KeyError, TypeError):
            return 0

    def is_running(self) -> bool:
        """Whether a process still has the file of the messages. Its number alone may be another's by now."""
        if sys.platform == "win32":
            # There a file that is open cannot be renamed.
            try:
                os.replace(self.messages, self.messages)
            except OSError:
                return self.messages.exists()
            return False
        import fcntl

        try:
            with self.messages.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:
            pass
        return False

    def remove(self) -> None:
        for path in (self._path, self.messages, self.stop_file, self._errors):
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


class _ForeignProcess:
    """A process that another Blender has started, as far as `Training` uses one. Its exit status is not known."""

    stdout = None

    def __init__(self, pid: int, files: _ProcessFiles):
        self.pid, self._files = pid, files

    def poll(self) -> str | None:
        return None if self._files.is_running() else "ended"

    def wait(self, seconds: float = float("inf")) -> None:
        end = time.monotonic() + seconds
        while self.poll() is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired(str(self.pid), seconds)
            time.sleep(POLL_SECONDS)

    def terminate(self) -> None:
        self._send(signal.SIGTERM)

    def kill(self) -> None:
        self._send(getattr(signal, "SIGKILL", signal.SIGTERM))

    def _send(self, number: int) -> None:
        # Its number alone may be that of another process by now.
        if self._files.is_running():
            with contextlib.suppress(OSError):
                os.kill(self.pid, number)
