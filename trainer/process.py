# SPDX-License-Identifier: GPL-3.0-or-later
"""What each process of the trainer does beside its work: it hears a request to stop, and ends with one last message."""

import os
import signal
import sys
import traceback
from collections.abc import Callable

from fdda_addon.core.errors import TRY_AGAIN, FDDAError, TrainingError, exit_status, machine_sentence
from fdda_addon.core.messages import MessageType

from .announcements import Announcer

INTERRUPTED = 130
# Threads of OpenMP that wait by spinning make training ten times slower on a machine that is busy with something else,
# and no faster on one that is not. Read when torch loads.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# Half the processors: the networks are small, and a second thread on two busy processors costs far more than it brings.
os.environ.setdefault("OMP_NUM_THREADS", str(max(1, (os.cpu_count() or 2) // 2)))


class Cancelled(Exception):  # noqa: N818 - no error
    """The work stopped because it was asked to."""


class StopRequest:
    """True once the process was asked to end: Ctrl-C, or SIGTERM from the add-on."""

    def __init__(self):
        self.requested = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._request)

    def _request(self, *_) -> None:
        self.requested = True

    def __call__(self) -> bool:
        return self.requested


def run_announced(work: Callable[[], None], announcer: Announcer) -> int:
    """Do the work; returns the exit status. Every way out but a broken pipe announces one last message.

    Args:
        work: announces its own end when it is done; raises `Cancelled` when it was asked to stop.
        announcer: receives the messages.
    """
    try:
        try:
            work()
        except Cancelled:
            announcer.say(MessageType.CANCELLED)
            return INTERRUPTED
        except FDDAError as error:
            return _failed(str(error), announcer, exit_status(error))
        except BrokenPipeError:
            raise
        except Exception as error:  # The boundary: the add-on waits for a last message, whatever happened.
            if _lacks_memory(error):
                text = f"The training lacks memory ({error}); free some, or train on a larger machine."
                return _failed(" ".join(text.split()), announcer, TRY_AGAIN)
            if text := machine_sentence(error):
                return _failed(text, announcer, TRY_AGAIN)
            traceback.print_exc()
            return _failed(f"The trainer stopped on an error of its own ({error!r}); please report it.", announcer)
    except BrokenPipeError:
        # Whoever started the process is gone. Python would complain once more when it closes stdout.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


def _lacks_memory(error: Exception) -> bool:
    """Whether numpy or torch found no memory. torch is not imported here: it may be what is missing."""
    kinds = {kind.__name__ for kind in type(error).__mro__}
    return bool(kinds & {"MemoryError", "OutOfMemoryError"}) or "can't allocate memory" in str(error)


def _failed(text: str, announcer: Announcer, status: int = 1) -> int:
    announcer.say(MessageType.FAILED, text=text, **({"try_again": True} if status == TRY_AGAIN else {}))
    print(text, file=sys.stderr)
    return status


def missing_package(work: str, error: ModuleNotFoundError) -> TrainingError:
    """The error of a process whose Python lacks a package; `work` is what it cannot do, the start of the sentence."""
    package = str(error.name).partition(".")[0]
    return TrainingError(
        f"{work} needs the Python package '{package}', which {sys.executable} does not have; install torch, onnx, "
        "onnxruntime, numpy, scipy and matplotlib there, create the trainer environment in the preferences of the "
        "add-on, or set FDDA_TRAINER_PYTHON to a Python that has them."
    )
