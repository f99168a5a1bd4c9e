# SPDX-License-Identifier: GPL-3.0-or-later
"""Process control of the trainer: requests to stop, exit statuses, and the last message."""

import errno
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from fdda_addon.core.errors import (
    TRY_AGAIN,
    FDDAError,
    TrainingError,
    exit_status,
    machine_fault_sentence,
    to_single_line,
)
from fdda_addon.core.messages import STOP_FILE_VARIABLE, MessageType
from fdda_addon.core.native_library import runtime_advice
from fdda_addon.core.stop_signals import INTERRUPTED, handle_stop_signals

from .progress import MessageSink

POLL_SECONDS = 0.1
"""Minimum time between checks for the stop file."""
MEMORY_ERROR_TEXTS = ("can't allocate memory", "not enough memory", "bad allocation", "bad_alloc", "WinError 1455")
"""Error texts of torch and ONNX Runtime on Linux and Windows; 1455 is a paging file that is too small."""
# Spinning OpenMP threads make training ten times slower on a busy machine, and no faster on an idle one. torch reads
# the variable when it loads.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Half the processors: the networks are small, and a second thread on two busy processors makes training slower.
os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 2) // 2)))


class Cancelled(Exception):  # noqa: N818 - a request, not an error
    """Raised when the work stops on request."""


class StopRequest:
    """A request to stop, by a signal (Ctrl-C, SIGTERM, …) or by the add-on's stop file; call it to check."""

    def __init__(self):
        self.requested = False
        self._file = os.environ.get(STOP_FILE_VARIABLE, "")
        self._next_poll = 0.0
        handle_stop_signals(self._request)

    def _request(self, *_) -> None:
        self.requested = True

    def __call__(self) -> bool:
        if not self.requested and self._file and (now := time.monotonic()) >= self._next_poll:
            self._next_poll = now + POLL_SECONDS
            self.requested = os.path.exists(self._file)
            if self.requested:
                # The process that created it may be gone.
                with suppress(OSError):
                    os.unlink(self._file)
        return self.requested

    @contextmanager
    def exit_immediately(self, sink: MessageSink) -> Iterator[None]:
        """Let a request end the process immediately, while torch loads, which can take half a minute.

        Raises:
            Cancelled: the stop was requested before.
        """
        if self():
            raise Cancelled
        is_done = threading.Event()

        def watch() -> None:
            while not is_done.wait(POLL_SECONDS):
                if self():
                    os._exit(_send_last(sink, INTERRUPTED, MessageType.CANCELLED))

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            is_done.set()
            watcher.join()


def run_with_messages(work: Callable[[], None], sink: MessageSink) -> int:
    """Run the work and send one last message, except after a broken pipe; returns the exit status.

    Args:
        work: sends its own last message when it succeeds; raises `Cancelled` when it is stopped.
        sink: receives the messages.
    """
    try:
        work()
    except Cancelled:
        return _send_last(sink, INTERRUPTED, MessageType.CANCELLED)
    except BrokenPipeError:
        _close_output()
        return 1
    except Exception as error:  # The add-on waits for a last message, whatever happened.
        text, status = _describe_error(error)
        values = {"text": text, **({"try_again": True} if status == TRY_AGAIN else {})}
        status = _send_last(sink, status, MessageType.FAILED, **values)
        with suppress(OSError):
            print(text, file=sys.stderr)
        return status
    return 0


def _send_last(sink: MessageSink, status: int, kind: MessageType, **values) -> int:
    """Send the last message, if the output takes it; returns the exit status."""
    try:
        sink.send(kind, **values)
    except OSError as error:
        _close_output()
        return 1 if isinstance(error, BrokenPipeError) else status
    return status


def _close_output() -> None:
    """Discard buffered output: flushing it at exit would fail again, and change the exit status."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _describe_error(error: Exception) -> tuple[str, int]:
    """Return a sentence for an error that ended the work, and the exit status."""
    if isinstance(error, FDDAError):
        return str(error), exit_status(error)
    cause: BaseException = error
    while cause.__cause__ is not None and not isinstance(cause, OSError | MemoryError):
        cause = cause.__cause__
    if _lacks_memory(cause):
        return to_single_line(
            f"The training lacks memory ({cause}); free some, or train on a larger machine."
        ), TRY_AGAIN
    if text := machine_fault_sentence(cause):
        return text, TRY_AGAIN
    if advice := runtime_advice(str(error)):
        return to_single_line(f"A library of '{sys.executable}' cannot be loaded ({error}); {advice}."), 1
    with suppress(OSError):
        traceback.print_exc()
    return f"The trainer stopped on an error of its own ({error!r}); please report it.", 1


def _lacks_memory(error: BaseException) -> bool:
    """Return whether numpy or torch ran out of memory. torch is not imported, as it may be missing."""
    class_names = {cls.__name__ for cls in type(error).__mro__}
    if class_names & {"MemoryError", "OutOfMemoryError"} or getattr(error, "errno", None) == errno.ENOMEM:
        return True
    return any(text in str(error) for text in MEMORY_ERROR_TEXTS)


def missing_package(work: str, error: ModuleNotFoundError) -> TrainingError:
    """Make the error of a process whose Python lacks a package; `work` is the subject of the sentence."""
    package = str(error.name).partition(".")[0]
    return TrainingError(
        f"{work} needs the Python package '{package}', which {sys.executable} does not have; install torch, onnx, "
        "onnxruntime, numpy, scipy and matplotlib there, install the training environment in the preferences of the "
        "add-on, or set FDDA_TRAINER_PYTHON to a Python that has them."
    )
