# SPDX-License-Identifier: GPL-3.0-or-later
"""What each process of the trainer does beside its work: notice a request to stop, and end with one last message."""

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

from .announcements import Announcer

LOOK_SECONDS = 0.1
"""How often the stop file is looked for, at most."""
NO_MEMORY = ("can't allocate memory", "not enough memory", "bad allocation", "bad_alloc", "WinError 1455")
"""What torch and ONNX Runtime say, on Linux and on Windows; 1455 is a paging file that is too small."""
# Threads of OpenMP that wait by spinning make training ten times slower on a machine that is busy with something else,
# and no faster on one that is not. Read when torch loads.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Half the processors: the networks are small, and a second thread on two busy processors costs far more than it brings.
os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 2) // 2)))


class Cancelled(Exception):  # noqa: N818 - no error
    """The work stopped because it was asked to."""


class StopRequest:
    """True once the process was asked to stop: by a signal (Ctrl-C, SIGTERM, …) or by the add-on's stop file."""

    def __init__(self):
        self.requested = False
        self._file = os.environ.get(STOP_FILE_VARIABLE, "")
        self._next_look = 0.0
        handle_stop_signals(self._request)

    def _request(self, *_) -> None:
        self.requested = True

    def __call__(self) -> bool:
        if not self.requested and self._file and (now := time.monotonic()) >= self._next_look:
            self._next_look = now + LOOK_SECONDS
            self.requested = os.path.exists(self._file)
            if self.requested:
                # Heard; whoever has created it may be gone.
                with suppress(OSError):
                    os.unlink(self._file)
        return self.requested

    @contextmanager
    def at_once(self, announcer: Announcer) -> Iterator[None]:
        """Inside, where nothing is written yet, a request ends the process: torch can take half a minute to load.

        Raises:
            Cancelled: it was asked before.
        """
        if self():
            raise Cancelled
        is_over = threading.Event()

        def watch() -> None:
            while not is_over.wait(LOOK_SECONDS):
                if self():
                    os._exit(_end(announcer, INTERRUPTED, MessageType.CANCELLED))

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            is_over.set()
            watcher.join()


def run_announced(work: Callable[[], None], announcer: Announcer) -> int:
    """Do the work; returns the exit status. Every way out but a broken pipe announces one last message.

    Args:
        work: announces its own end when it is done; raises `Cancelled` when it was asked to stop.
        announcer: receives the messages.
    """
    try:
        work()
    except Cancelled:
        return _end(announcer, INTERRUPTED, MessageType.CANCELLED)
    except BrokenPipeError:
        _close_output()
        return 1
    except Exception as error:  # The boundary: the add-on waits for a last message, whatever happened.
        text, status = _explain(error)
        values = {"text": text, **({"try_again": True} if status == TRY_AGAIN else {})}
        status = _end(announcer, status, MessageType.FAILED, **values)
        with suppress(OSError):
            print(text, file=sys.stderr)
        return status
    return 0


def _end(announcer: Announcer, status: int, kind: MessageType, **values) -> int:
    """Announce the last message, as far as there is room for it; returns the exit status."""
    try:
        announcer.say(kind, **values)
    except OSError as error:
        _close_output()
        return 1 if isinstance(error, BrokenPipeError) else status
    return status


def _close_output() -> None:
    """Drop what stdout still holds: Python would complain once more when it closes it, and change the exit status."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _explain(error: Exception) -> tuple[str, int]:
    """The sentence for an error that ended the work, and the exit status."""
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
    """Whether numpy or torch found no memory. torch is not imported here: it may be what is missing."""
    kinds = {kind.__name__ for kind in type(error).__mro__}
    if kinds & {"MemoryError", "OutOfMemoryError"} or getattr(error, "errno", None) == errno.ENOMEM:
        return True
    return any(words in str(error) for words in NO_MEMORY)


def missing_package(work: str, error: ModuleNotFoundError) -> TrainingError:
    """The error of a process whose Python lacks a package; `work` is what it cannot do, the start of the sentence."""
    package = str(error.name).partition(".")[0]
    return TrainingError(
        f"{work} needs the Python package '{package}', which {sys.executable} does not have; install torch, onnx, "
        "onnxruntime, numpy, scipy and matplotlib there, install the training environment in the preferences of the "
        "add-on, or set FDDA_TRAINER_PYTHON to a Python that has them."
    )
