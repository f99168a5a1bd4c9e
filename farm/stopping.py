# SPDX-License-Identifier: GPL-3.0-or-later
"""Ends all processes that a farm started when the farm ends for any reason: workers, verbs and trainers.

Process groups and parents do not lead to all of them, because verbs have their own sessions and outlive a killed
worker. All processes inherit a mark in their environment instead. If the farm is killed, a watcher process outside its
session finds the processes with the mark and ends them.
"""

import contextlib
import os
import secrets
import signal
import sys
import time
from collections.abc import Callable, Iterator
from typing import NoReturn

MARK_VARIABLE = "FDDA_FARM_RUN"
"""Environment variable that marks all processes of one run of the farm."""
GRACE_SECONDS = 10.0
"""Seconds between SIGTERM and SIGKILL."""
POLL_SECONDS = 0.05
STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
SIGNAL_STATUS_OFFSET = 128
"""Exit status of a process that a signal ended, minus the number of the signal, as shells report it."""


class StoppedBySignal(KeyboardInterrupt):
    """A signal asked the farm to stop: Ctrl-C, SIGTERM, or SIGHUP of a closed terminal.

    Attributes:
        exit_status: `SIGNAL_STATUS_OFFSET` plus the number of the signal.
    """

    def __init__(self, signal_number: int):
        super().__init__(f"signal {signal_number}")
        self.exit_status = SIGNAL_STATUS_OFFSET + signal_number


def run_and_end_processes(run_farm: Callable[[], int]) -> NoReturn:
    """Run the farm, end all processes that it started, and exit with the status that `run_farm` returns."""
    os.environ[MARK_VARIABLE] = mark = secrets.token_hex(16)
    watcher_pipe = _start_watcher(mark)
    # Python's resource tracker warns about shared memory of workers that were killed.
    sys.warnoptions.append("ignore:resource_tracker:UserWarning")
    for signal_number in STOP_SIGNALS:
        # A signal that the parent ignores, as nohup does, stays ignored.
        if signal.getsignal(signal_number) is not signal.SIG_IGN:
            signal.signal(signal_number, _raise_stopped)
    try:
        status = run_farm()
    except BaseException:
        _ignore_stop_signals()
        end_marked_processes(mark)
        raise
    _ignore_stop_signals()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    # Replace the program of this process, so that no thread of Dask can start workers again.
    os.set_inheritable(watcher_pipe, True)
    environment = {name: value for name, value in os.environ.items() if name != MARK_VARIABLE}
    os.execve(sys.executable, [sys.executable, "-I", "-S", __file__, mark, str(status)], environment)


def _raise_stopped(signal_number: int, _frame: object) -> None:
    # Ignore further signals: a second one would interrupt the cleanup.
    _ignore_stop_signals()
    raise StoppedBySignal(signal_number)


def _ignore_stop_signals() -> None:
    for signal_number in STOP_SIGNALS:
        signal.signal(signal_number, signal.SIG_IGN)


def _start_watcher(mark: str) -> int:
    """Start the watcher process; return the end of a pipe. When it is closed, the watcher ends all marked processes."""
    reader, writer = os.pipe()
    if os.fork():
        os.close(reader)
        return writer
    try:
        # Leave the session and the output of the farm, so that a signal to its process group does not end the watcher,
        # and a program that reads the output does not wait for the watcher.
        os.setsid()
        _ignore_stop_signals()
        null = os.open(os.devnull, os.O_RDWR)
        for stream in range(3):
            os.dup2(null, stream)
        os.dup2(reader, 3)
        os.closerange(4, os.sysconf("SC_OPEN_MAX"))
        os.read(3, 1)
        end_marked_processes(mark)
    finally:
        os._exit(0)


def end_marked_processes(mark: str) -> None:
    """End all marked processes, and kill those that do not end in time."""
    start, terminated, was_empty = time.monotonic(), set(), False
    while time.monotonic() < start + 2 * GRACE_SECONDS:
        is_late = time.monotonic() > start + GRACE_SECONDS
        process_ids = list(_find_marked_processes(mark))
        if not process_ids and was_empty:
            return
        # Search twice, because a process that is just being started may not show its environment yet.
        was_empty = not process_ids
        for process_id in process_ids:
            if is_late or process_id not in terminated:
                terminated.add(process_id)
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.kill(process_id, signal.SIGKILL if is_late else signal.SIGTERM)
        time.sleep(POLL_SECONDS)


def _find_marked_processes(mark: str) -> Iterator[int]:
    """Yield the IDs of the marked processes except this one; none on systems without /proc."""
    entry = f"{MARK_VARIABLE}={mark}".encode()
    for name in os.listdir("/proc") if sys.platform == "linux" else ():
        if name.isdecimal() and int(name) != os.getpid():
            with contextlib.suppress(OSError), open(f"/proc/{name}/environ", "rb") as file:
                if entry in file.read().split(b"\0"):
                    yield int(name)


if __name__ == "__main__":
    end_marked_processes(sys.argv[1])
    sys.exit(int(sys.argv[2]))
