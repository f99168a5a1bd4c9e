# SPDX-License-Identifier: GPL-3.0-or-later
"""Ending of all child processes of a farm when it ends in any way: workers, verbs and trainers.

Verbs have sessions of their own, and outlast a worker that is killed, so neither process groups nor parents lead to
them. All of them inherit a mark in their environment. A watcher outside of the farm's session looks for it when the
farm is gone without a chance to do so itself.
"""

import contextlib
import os
import secrets
import signal
import sys
import time
from collections.abc import Callable, Iterator
from typing import NoReturn

MARK = "FDDA_FARM_RUN"
"""Variable of the environment of whatever a run of the farm has started."""
GRACE_SECONDS = 10.0
"""A process that was asked to end is killed after so long."""
POLL_SECONDS = 0.05
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
STATUS_OF_SIGNAL = 128


class StoppedBySignal(KeyboardInterrupt):
    """A signal asked the farm to stop: Ctrl-C, SIGTERM, or SIGHUP of a closed terminal.

    Attributes:
        exit_status: 128 and the number of the signal, as a shell has it.
    """

    def __init__(self, number: int):
        super().__init__(f"signal {number}")
        self.exit_status = STATUS_OF_SIGNAL + number


def end_all_when_done(work: Callable[[], int]) -> NoReturn:
    """Run the farm, end its child processes, and exit with the status of `work`."""
    os.environ[MARK] = mark = secrets.token_hex(16)
    lifeline = _start_watcher(mark)
    # Of Python's own helper, which tidies up after the workers that were ended.
    sys.warnoptions.append("ignore:resource_tracker:UserWarning")
    for number in SIGNALS:
        # Whoever had one ignored, as nohup does, still wants that.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _raise_stopped)
    try:
        status = work()
    except BaseException:
        _ignore()
        end_marked_processes(mark)
        raise
    _ignore()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    # Another program in this process: no thread of Dask is left that would start workers again.
    os.set_inheritable(lifeline, True)
    environment = {name: value for name, value in os.environ.items() if name != MARK}
    os.execve(sys.executable, [sys.executable, "-I", "-S", __file__, mark, str(status)], environment)


def _raise_stopped(number: int, _frame: object) -> None:
    # Once: a second one would break off what is in the way of ending the rest.
    _ignore()
    raise StoppedBySignal(number)


def _ignore() -> None:
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _start_watcher(mark: str) -> int:
    """Start the watcher; return the end of a pipe. When it is closed, the watcher ends all marked processes."""
    reader, writer = os.pipe()
    if os.fork():
        os.close(reader)
        return writer
    try:
        # Whoever kills the session or the group of the farm does not reach it, and waits for no output of it.
        os.setsid()
        _ignore()
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
    start, asked, is_none = time.monotonic(), set(), False
    while time.monotonic() < start + 2 * GRACE_SECONDS:
        is_late = time.monotonic() > start + GRACE_SECONDS
        found = list(_find_marked_processes(mark))
        if not found and is_none:
            return
        # What has just been forked shows the environment of its parent until it is a program of its own: look twice.
        is_none = not found
        for process in found:
            if is_late or process not in asked:
                asked.add(process)
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.kill(process, signal.SIGKILL if is_late else signal.SIGTERM)
        time.sleep(POLL_SECONDS)


def _find_marked_processes(mark: str) -> Iterator[int]:
    """Find the marked processes except this one; empty on systems without /proc."""
    wanted = f"{MARK}={mark}".encode()
    for name in os.listdir("/proc") if sys.platform == "linux" else ():
        if name.isdecimal() and int(name) != os.getpid():
            with contextlib.suppress(OSError), open(f"/proc/{name}/environ", "rb") as file:
                if wanted in file.read().split(b"\0"):
                    yield int(name)


if __name__ == "__main__":
    end_marked_processes(sys.argv[1])
    sys.exit(int(sys.argv[2]))
