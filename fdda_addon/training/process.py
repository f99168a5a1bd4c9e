# SPDX-License-Identifier: GPL-3.0-or-later
"""Starts the trainer in another process, reads its messages, and cancels it.

torch runs outside of Blender's process, because it has its own threads and libraries, and Blender's Python lacks it.
"""

import secrets
import shutil
import subprocess
import tempfile
import time
import weakref
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Self, TextIO

from ..core.errors import TRY_AGAIN, TrainingDiedError, TrainingError, WrongUsageError, os_error_text
from ..core.files.child_process import OutputLines, child_environment, child_options, end_process
from ..core.files.native_library import runtime_advice
from ..core.files.stop_signals import INTERRUPTED
from ..core.files.temporary import check_temporary_folder, new_temporary_file
from ..core.formats.messages import STOP_FILE_VARIABLE, Message, MessageType
from .environment.choice import select_python
from .environment.folder import ROOT
from .process_exit import explain_exit_status

KILL_AFTER_SECONDS = 20.0
"""Time after which a canceled trainer that still runs is killed."""
READER_JOIN_SECONDS = 1.0
POLL_SECONDS = 0.05
MIN_FREE_BYTES = 1 << 16
"""Free space below which a disk counts as full."""


def trainer_python() -> str:
    """Return the path of the Python that runs the trainer (`training.environment.choice`)."""
    return select_python().path


def trainer_command(
    arguments: list[str], python: str | None = None, module: str = "trainer"
) -> tuple[list[str], dict[str, str]]:
    """Return the command line and the environment variables that start the trainer.

    Args:
        arguments: arguments of `python -m trainer`.
        python: path of the interpreter; None for `trainer_python()`.
        module: name of the module to run.
    """
    # -P, so that a folder `trainer` in the current folder is not run instead.
    return [python or trainer_python(), "-P", "-m", module, *arguments], child_environment(ROOT)


class TrainerProcess:
    """Context manager for a trainer process, which ends with the `with` block.

    Attributes:
        module: name of the module that `python -m` runs.
        failure_message: error message if the process gives none.
        loss_advice: end of the error message if the process ended without a result.
    """

    module = "trainer"
    _finalizer: weakref.finalize | None = None
    failure_message = "The training failed."
    loss_advice = "no model was written, train again"

    def __init__(self, arguments: list[str], python: str | None = None):
        """Start the process.

        Args:
            arguments: arguments of the module.
            python: path of the interpreter; None for `trainer_python()`.

        Raises:
            TrainingError: the interpreter cannot be started.
            OutputError: the file for stderr cannot be written.
        """
        advice = select_python().origin.value if python is None else "name a Python that has torch"
        command, _ = trainer_command(arguments, python, self.module)
        self._stop_file, self._errors = self._new_stop_file(), self._new_errors()
        # Ctrl-C may arrive between the start of the process and the `with` block that ends it.
        self._finalizer = weakref.finalize(self, Path.touch, self._stop_file)
        try:
            self._process = self._start(command)
        except OSError as error:
            self._finalizer.detach()
            self._errors.close()
            raise TrainingError(
                f"The trainer's Python '{command[0]}' cannot be started ({os_error_text(error)}); {advice}."
            ) from error
        self._start_reader()

    def _new_stop_file(self) -> Path:
        # The file exists only after a cancellation. Its random name keeps other users from creating it.
        check_temporary_folder()
        return Path(tempfile.gettempdir(), f"fdda-stop-{secrets.token_hex(12)}")

    def _new_errors(self) -> TextIO:
        return new_temporary_file()

    def _start(self, command: list[str]) -> subprocess.Popen:
        return self._popen(command, subprocess.PIPE)

    def _popen(self, command: list[str], output: IO | int, own_session: bool = False) -> subprocess.Popen:
        options = child_options(ROOT, own_session=own_session)
        options["env"][STOP_FILE_VARIABLE] = str(self._stop_file)
        return subprocess.Popen(command, stdout=output, stderr=self._errors, **options)

    def _start_reader(self) -> None:
        self._canceled_at: float | None = None
        self._lines = OutputLines(self._read())

    def _read(self) -> Iterator[str]:
        yield from self._process.stdout

    def cancel(self) -> None:
        """Request the trainer to stop, without waiting. `messages` ends when the trainer has stopped."""
        if self._canceled_at is not None:
            return
        self._canceled_at = time.monotonic()
        try:
            self._stop_file.touch()
        except OSError:
            # The disk is full. On Windows `terminate` ends the process at once.
            self._process.terminate()

    def messages(self, wait: bool = True) -> Iterator[Message | None]:
        """Yield the messages of the trainer until it has finished or was canceled.

        Args:
            wait: whether to block until the next message; if not, yield None while there is no message.

        Raises:
            WrongUsageError: the options of the trainer are wrong.
            TrainingError: the trainer failed, or ended without a last message and without a cancellation.
        """
        last_message = None
        while True:
            if self._canceled_at is not None and time.monotonic() > self._canceled_at + KILL_AFTER_SECONDS:
                self._process.kill()
            # A short timeout, because on Windows a blocked thread receives no Ctrl-C.
            line = self._lines.next(POLL_SECONDS if wait else 0)
            if line is None:
                break
            if not line:
                if not wait:
                    yield None
                continue
            try:
                message = Message.decode(line)
            except ValueError:
                # A library may print other lines.
                continue
            if message.type is MessageType.FAILED:
                kind = TrainingDiedError if message.values.get("try_again") is True else TrainingError
                raise kind(str(message.values.get("text", self.failure_message)))
            yield message
            last_message = message
        while self._process.poll() is None:
            if wait:
                time.sleep(POLL_SECONDS)
            else:
                yield None
        status = self._process.wait()
        if self._canceled_at is not None:
            return
        if status == WrongUsageError.exit_status and last_message is None:
            raise WrongUsageError(self._error_text().strip())
        if last_message is None or not last_message.type.is_last:
            if status == INTERRUPTED:
                # The trainer was interrupted before its first message.
                yield Message(MessageType.CANCELLED)
                return
            raise self._exit_error(status)

    def _exit_error(self, status: int | None) -> TrainingError:
        error_lines = self._error_text().strip().splitlines()
        reason = f" ({error_lines[-1].strip()})" if error_lines else ""
        process_exit = explain_exit_status(status, not error_lines)
        if status == TRY_AGAIN and (full_folder := self._find_full_disk()):
            # The trainer could not write its error message.
            return TrainingDiedError(f"The disk of '{full_folder}' is full; {self.loss_advice} when there is room.")
        kind = TrainingDiedError if process_exit.is_machine_fault else TrainingError
        if advice := runtime_advice(reason):
            return kind(f"The trainer {process_exit.text}{reason}; {advice}, and train again.")
        return kind(f"The trainer {process_exit.text}{reason}; {self.loss_advice}.")

    def _find_full_disk(self) -> Path | None:
        """Return a folder that the trainer writes to and whose disk is full; None if no disk is full."""
        for get_folder in (lambda: str(self._stop_file.parent), tempfile.gettempdir):
            with suppress(OSError):
                if shutil.disk_usage(folder := get_folder()).free < MIN_FREE_BYTES:
                    return Path(folder)
        return None

    def _error_text(self) -> str:
        self._errors.seek(0)
        return self._errors.read()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            if self._process.poll() is None:
                self.cancel()
        finally:
            end_process(self._process, KILL_AFTER_SECONDS)
            if self._finalizer is not None:
                self._finalizer.detach()
            with suppress(OSError):
                self._stop_file.unlink(missing_ok=True)
        # A child process of the trainer may keep the pipe open; then the reader thread continues.
        if self._lines.join(READER_JOIN_SECONDS) and self._process.stdout is not None:
            self._process.stdout.close()
        self._errors.close()


class Training(TrainerProcess):
    """Context manager for the process of a training, whose arguments are recording, model and options."""
