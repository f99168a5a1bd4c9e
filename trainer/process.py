# SPDX-License-Identifier: GPL-3.0-or-later
"""The trainer as a process: requests to stop it, exit statuses, and the last message that it sends."""

import errno
import os
import select
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

from fdda_addon.core.errors import (
    TRY_AGAIN,
    FDDAError,
    TrainingError,
    exit_status,
    machine_fault_sentence,
    to_single_line,
)
from fdda_addon.core.files.native_library import lacks_memory, runtime_advice
from fdda_addon.core.files.stop_signals import INTERRUPTED, handle_stop_signals
from fdda_addon.core.formats.messages import STOP_FILE_VARIABLE, MessageType

from .progress import OUTPUT_LOCK, MessageSink

POLL_SECONDS = 0.1
"""Time between checks for a stop request."""
# OpenMP threads that wait actively make training ten times slower on a busy machine, and no faster on an idle machine.
# torch reads the variable when it loads.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# The networks are small: a second thread on two busy processors makes training slower, so half the processors are used.
os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 2) // 2)))


class StopRequest:
    """A request to stop the process, by a signal (Ctrl-C, SIGTERM, …) or by the add-on's stop file."""

    def __init__(self, sink: MessageSink):
        """Receive requests from now on; `sink` receives the last message of a stopped process."""
        self._sink, self._is_requested = sink, False
        self._stop_file = os.environ.get(STOP_FILE_VARIABLE, "")
        handle_stop_signals(self._request)

    def _request(self, *_) -> None:
        self._is_requested = True

    @contextmanager
    def exit_immediately(self) -> Iterator[None]:
        """Let a stop request, an earlier one too, end the process at once. The block must not write files that stay."""
        is_done = threading.Event()

        def watch() -> None:
            is_last_look = False
            while not is_last_look:
                is_last_look = is_done.wait(POLL_SECONDS)
                if self._stop_file and os.path.exists(self._stop_file):
                    self._request()
                    # The stop file is deleted here, because the process that created it may have ended.
                    with suppress(OSError):
                        os.unlink(self._stop_file)
                if self._is_requested or _is_reader_gone():
                    # The lock is not released, so that no message follows the last one.
                    OUTPUT_LOCK.acquire()
                    os._exit(_send_last_message(self._sink, INTERRUPTED, MessageType.CANCELLED))

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            is_done.set()
            watcher.join()


def _is_reader_gone() -> bool:
    """Return whether the process that read the messages has ended; on Windows, only the next message fails."""
    if not hasattr(select, "poll"):
        return False
    poll = select.poll()
    poll.register(1, 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def run_with_messages(run_job: Callable[[], None], sink: MessageSink) -> int:
    """Run a job and send one last message, except after a broken pipe; returns the exit status.

    Args:
        run_job: runs the job. It sends the last message itself when it succeeds.
        sink: receives the messages.
    """
    try:
        run_job()
    except BrokenPipeError:
        _discard_output(sys.stdout)
        return 1
    except Exception as error:  # The add-on waits for a last message, whatever happened.
        text, status = _describe_error(error)
        values = {"text": text, **({"try_again": True} if status == TRY_AGAIN else {})}
        status = _send_last_message(sink, status, MessageType.FAILED, **values)
        try:
            print(text, file=sys.stderr, flush=True)
        except OSError:
            _discard_output(sys.stderr)
        return status
    return 0


def _send_last_message(sink: MessageSink, status: int, message_type: MessageType, **values) -> int:
    """Send the last message, unless the output is closed; returns the exit status."""
    try:
        sink.send(message_type, **values)
    except OSError as error:
        _discard_output(sys.stdout)
        return 1 if isinstance(error, BrokenPipeError) else status
    return status


def _discard_output(stream: TextIO) -> None:
    """Discard buffered output, because flushing it at exit would fail again and change the exit status."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _describe_error(error: Exception) -> tuple[str, int]:
    """Return a sentence for an error that ended the job, and the exit status."""
    if isinstance(error, FDDAError):
        return str(error), exit_status(error)
    cause: BaseException = error
    while cause.__cause__ is not None and not isinstance(cause, OSError | MemoryError):
        cause = cause.__cause__
    if _is_memory_error(cause):
        return to_single_line(
            f"The training lacks memory ({cause}); free some, or train on a larger machine."
        ), TRY_AGAIN
    if advice := runtime_advice(str(error)):
        return to_single_line(f"A library of '{sys.executable}' cannot be loaded ({error}); {advice}."), 1
    if text := machine_fault_sentence(cause):
        return text, TRY_AGAIN
    with suppress(OSError):
        traceback.print_exc()
    return f"The trainer stopped on an error of its own ({error!r}); please report it.", 1


def _is_memory_error(error: BaseException) -> bool:
    """Return whether numpy or torch ran out of memory. torch may be missing, so its error is recognized by name."""
    class_names = {cls.__name__ for cls in type(error).__mro__}
    if class_names & {"MemoryError", "OutOfMemoryError"} or getattr(error, "errno", None) == errno.ENOMEM:
        return True
    return lacks_memory(str(error))


def missing_package_error(activity: str, error: ModuleNotFoundError) -> TrainingError:
    """Return the error for a package that Python lacks; `activity` is the subject of its sentence."""
    package = str(error.name).partition(".")[0]
    return TrainingError(
        f"{activity} needs the Python package '{package}', which {sys.executable} does not have; install torch, onnx, "
        "onnxruntime, numpy, scipy and jinja2 there, install the training environment in the preferences of the "
        "add-on, or set FDDA_TRAINER_PYTHON to a Python that has them."
    )
