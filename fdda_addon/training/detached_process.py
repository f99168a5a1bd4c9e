# SPDX-License-Identifier: GPL-3.0-or-later
"""Detached trainings, which continue when Blender quits, crashes, or opens another file.

The trainer writes its messages to a file in the add-on's user folder, whose name depends on the path of the model. When
the character is opened again, Blender reads all messages from the first one, even if the training has ended meanwhile.
Files next to a model are untrusted, so the process id is not stored there.
"""

import contextlib
import hashlib
import io
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, TextIO

from ..core.errors import OutputError, os_error_text
from ..core.files.file_lock import NoLocksError, has_ended, try_lock
from ..core.files.output import write_json
from .environment.folder import user_folder
from .process import Training

SIGNAL_CHECKS = 4 if sys.platform == "win32" else 1
"""Checks before a process is ended: on Windows, a Blender that reads the messages has them open for a moment, too."""
POLL_SECONDS = 0.1
_child_processes: dict[int, subprocess.Popen] = {}
"""Trainer processes that this Blender has started, by process id. Only their exit status can be read."""


class DetachedTraining(Training):
    """A training that continues after its `with` block if `detach` was called; otherwise it ends with the block."""

    def __init__(self, arguments: list[str], model: Path):
        """Start the trainer.

        Args:
            arguments: of `python -m trainer`.
            model: the file to write. Only one training at a time may write it.

        Raises:
            TrainingError: the interpreter cannot be started.
            OutputError: the files of the process cannot be written.
        """
        self._files, self._is_detached = _ProcessFiles(model), False
        super().__init__(arguments)
        _child_processes[self._process.pid] = self._process
        try:
            self._files.write_process_id(self._process.pid)
        except OutputError:
            # Without its process id no Blender could attach to the training.
            self.__exit__()
            raise

    def _new_stop_file(self) -> Path:
        self._files.remove()
        return self._files.stop_file

    def _new_errors(self) -> TextIO:
        return self._files.new_errors()

    def _start(self, command: list[str]) -> subprocess.Popen:
        with self._files.new_messages() as file:
            return self._popen(command, file, own_session=True)

    def _read(self) -> Iterator[str]:
        offset, incomplete_line = 0, b""
        while not self._is_detached:
            # Checked before reading, so that all output of an ended process is read.
            is_alive = self._process.poll() is None
            try:
                with self._files.messages.open("rb") as file:
                    file.seek(offset)
                    chunk = file.read()
            except PermissionError:
                # On Windows, `is_running` in another thread may have the file open.
                time.sleep(POLL_SECONDS)
                continue
            except OSError:
                # Another Blender that follows the same training has read its end and removed the files.
                break
            offset += len(chunk)
            *lines, incomplete_line = (incomplete_line + chunk).split(b"\n")
            yield from (line.decode("utf-8", "replace") for line in lines)
            if not is_alive and not chunk:
                break
            time.sleep(0 if lines else POLL_SECONDS)

    def detach(self) -> None:
        """Let the training continue after the `with` block."""
        self._is_detached = True
        if self._finalizer is not None:
            self._finalizer.detach()

    def __exit__(self, *error: object) -> None:
        if self._is_detached:
            self._lines.join()
            self._errors.close()
            return
        super().__exit__(*error)
        self._files.remove()


class AttachedTraining(DetachedTraining):
    """A detached training to which this Blender has attached. It is read from its first message."""

    def __init__(self, model: Path):
        """Attach to the training of a model for which `is_detached` is true."""
        self._files, self._is_detached = _ProcessFiles(model), False
        self._stop_file, self._errors = self._files.stop_file, self._files.errors()
        pid = self._files.process_id
        self._process = _child_processes.get(pid) or _ForeignProcess(pid, self._files)
        self._start_reader()


def is_detached(model: Path) -> bool:
    """Return whether a model has a detached training that runs, or whose end no Blender has read."""
    return _ProcessFiles(model).process_id > 0


class _ProcessFiles:
    """Files of a detached training: process id, messages, stderr, and the stop file."""

    def __init__(self, model: Path):
        name = hashlib.sha256(os.path.normcase(model.resolve()).encode("utf-8", "surrogateescape")).hexdigest()[:24]
        self._path = user_folder() / "trainings" / f"{name}.json"
        self.messages = self._path.with_suffix(".messages")
        self.stop_file = self._path.with_suffix(".stop")
        self._errors = self._path.with_suffix(".errors")

    def new_messages(self) -> BinaryIO:
        """Create the file for messages. The trainer inherits its lock and holds it while it runs."""
        file = self._new(self.messages)
        if sys.platform != "win32":
            with contextlib.suppress(OSError):
                try_lock(file.fileno())
        return file

    def new_errors(self) -> TextIO:
        """Create the file for stderr."""
        return io.TextIOWrapper(self._new(self._errors), encoding="utf-8", errors="replace")

    def errors(self) -> TextIO:
        """Open the file with the stderr of the process; return an empty file if it is missing."""
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
        """Write the process id."""
        write_json(self._path, {"process": process_id, "host": socket.gethostname()})

    @property
    def process_id(self) -> int:
        """Return the process id; 0 without a detached training."""
        return self._read()[0] * self.messages.is_file()

    def _read(self) -> tuple[int, str]:
        """Return process id and host; id 0 without a detached training."""
        try:
            values = json.loads(self._path.read_text(encoding="utf-8"))
            return int(values["process"]), str(values["host"])
        except (OSError, ValueError, KeyError, TypeError):
            return 0, ""

    def is_running(self, is_certain: bool = False) -> bool:
        """Return whether a process has the file of messages open. Its id may have been reused by another process.

        Args:
            is_certain: whether to return False on a drive that cannot lock files. Otherwise the process counts as
                running there until it has ended for certain.
        """
        if sys.platform == "win32":
            # Windows cannot rename an open file.
            try:
                os.replace(self.messages, self.messages)
            except OSError:
                return self.messages.exists()
            return False
        try:
            with self.messages.open("rb") as file:
                return not try_lock(file.fileno(), is_shared=True)
        except NoLocksError:
            return not is_certain and not has_ended(*self._read())
        except OSError:
            return False

    def remove(self) -> None:
        for path in (self._path, self.messages, self.stop_file, self._errors):
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


class _ForeignProcess:
    """A process that another Blender has started, with the methods that `Training` uses. Its exit status is unknown."""

    stdout = None

    def __init__(self, pid: int, files: _ProcessFiles):
        self.pid, self._files, self._is_killed = pid, files, False

    def poll(self) -> str | None:
        return None if self._files.is_running() and not self._is_killed else "ended"

    def wait(self, seconds: float = float("inf")) -> None:
        deadline = time.monotonic() + seconds
        while self.poll() is None:
            if time.monotonic() > deadline:
                raise subprocess.TimeoutExpired(str(self.pid), seconds)
            time.sleep(POLL_SECONDS)

    def terminate(self) -> None:
        self._send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self._send_signal(getattr(signal, "SIGKILL", signal.SIGTERM))
        # The signal may not have been sent, and then nobody waits for the process.
        self._is_killed = True

    def _send_signal(self, signal_number: int) -> None:
        # The process id may be reused by another process.
        for _ in range(SIGNAL_CHECKS):
            if not self._files.is_running(is_certain=True):
                return
            time.sleep(POLL_SECONDS / 3)
        with contextlib.suppress(OSError):
            os.kill(self.pid, signal_number)
