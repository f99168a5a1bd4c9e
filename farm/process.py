# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a verb in its own process, with a lock and a log file."""

import contextlib
import os
import resource
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from fdda_addon.core.child_process import child_environment
from fdda_addon.core.errors import TRY_AGAIN, FDDAError
from fdda_addon.core.file_lock import NoLocksError, wait_for_lock

from .characters import Farm
from .fingerprints import ROOT
from .stopping import SIGNAL_STATUS_OFFSET

POLL_SECONDS = 0.05
MAX_LOG_TAIL_BYTES = 64 << 10
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
DASK_VARIABLES = ("MALLOC_TRIM_THRESHOLD_",)
"""Variables that Dask sets for its workers and that verbs must not inherit. This one makes the C library return freed
memory above 64 kB to the system. A training then takes a fifth longer, an evaluation of 50,618 vertices a third."""
MAXRSS_UNITS_PER_MB = 1024 if sys.platform != "darwin" else 1024 * 1024
"""The unit of `ru_maxrss` is kB on Linux and bytes on macOS."""


class VerbError(FDDAError):
    """A verb failed, and would fail again on any machine."""


class TryAgainError(FDDAError):
    """A verb failed because of its machine, and may succeed later."""

    exit_status = TRY_AGAIN


@dataclass(frozen=True)
class ProcessResult:
    """Wall-clock time of a verb, and the peak memory of its largest process."""

    seconds: float
    peak_mb: float


@contextlib.contextmanager
def hold_lock(path: Path) -> Iterator[int]:
    """Wait for the lock of a task and hold it; yield its file descriptor, which child processes inherit.

    The system releases the lock when the last process that has the descriptor ends. A verb whose worker was killed
    continues and still holds the lock. Another worker with the same task waits for the lock, and then finds the task
    done.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        try:
            wait_for_lock(descriptor)
        except NoLocksError as error:
            raise FDDAError(
                f"The farm locks its tasks, and cannot lock '{path}': {error.strerror}; put the farm on another drive."
            ) from error
        yield descriptor
    finally:
        os.close(descriptor)


def verb_command(farm: Farm, verb: tuple[str, ...]) -> list[str]:
    """Return the command line of a verb for `subprocess`."""
    if farm.blender and verb[0] not in ("train", "merge-recordings"):
        return [farm.blender, "--command", "fdda", *verb]
    return [farm.python or sys.executable, "-P", "-m", "fdda_addon", *verb]


def verb_environment(farm: Farm, verb: tuple[str, ...]) -> dict[str, str]:
    """Return the environment of a verb, without Dask's variables and with a fixed number of threads."""
    is_training = verb[0] == "train"
    environment = {name: value for name, value in child_environment(ROOT).items() if name not in DASK_VARIABLES}
    environment |= dict.fromkeys(THREAD_VARIABLES, str(farm.threads) if is_training else "1")
    if farm.trainer_python:
        environment["FDDA_TRAINER_PYTHON"] = farm.trainer_python
    if is_training and not farm.gpu:
        environment["CUDA_VISIBLE_DEVICES"] = ""
    return environment


def run_verb(
    farm: Farm, verb: tuple[str, ...], folder: Path, log: Path, lock: int, is_wanted: Callable[[], bool] = lambda: True
) -> ProcessResult:
    """Run a verb until it ends.

    Args:
        farm: settings of the farm.
        verb: name and options of the verb.
        folder: working directory of the verb.
        log: file to which the output of the verb is appended.
        lock: file descriptor from `hold_lock`, which the verb inherits.
        is_wanted: called repeatedly; when it returns False, the verb is terminated.

    Raises:
        VerbError: the verb failed; the message is its own.
        TryAgainError: the verb failed because of the machine, or a signal ended it.
    """
    command = verb_command(farm, verb)
    started = time.monotonic()
    with open(log, "ab") as output:
        output.write(f"$ {shlex.join(verb)}\n".encode())
        output.flush()
        start_offset = output.tell()
        try:
            process = subprocess.Popen(
                command,
                cwd=folder,
                env=verb_environment(farm, verb),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                pass_fds=(lock,),
                # Ctrl-C must only reach the farm, which then ends its verbs itself.
                start_new_session=True,
            )
        except OSError as error:
            raise VerbError(f"'{command[0]}' cannot be started ({error.strerror}); see [farm] in the plan.") from error
        try:
            status, usage = _wait_for_exit(process.pid, is_wanted)
        except BaseException:
            _terminate(process.pid)
            raise
    process.returncode = code = os.waitstatus_to_exitcode(status)
    if code < 0 or code > SIGNAL_STATUS_OFFSET:
        # A verb that handled the signal, or a shell around it, exits with 128 plus the signal's number.
        raise TryAgainError(f"{verb[0]} was ended by signal {-code if code < 0 else code - SIGNAL_STATUS_OFFSET}.")
    if code:
        sentence = _last_error_line(log, start_offset) or f"{verb[0]} ended with status {code}; see '{log}'."
        raise (TryAgainError if code == TRY_AGAIN else VerbError)(sentence)
    return ProcessResult(time.monotonic() - started, usage.ru_maxrss / MAXRSS_UNITS_PER_MB)


def _wait_for_exit(process_id: int, is_wanted: Callable[[], bool]) -> tuple[int, resource.struct_rusage]:
    """Wait for a verb; return its status and resource usage."""
    is_terminated = False
    while True:
        ended_process_id, status, usage = os.wait4(process_id, os.WNOHANG)
        if ended_process_id:
            return status, usage
        if not is_terminated and not is_wanted():
            is_terminated = True
            _terminate(process_id)
        time.sleep(POLL_SECONDS)


def _terminate(process_id: int) -> None:
    """Send SIGTERM to a verb and its child processes."""
    with contextlib.suppress(OSError):
        os.killpg(process_id, signal.SIGTERM)


def _last_error_line(log: Path, start_offset: int) -> str:
    """Return the last error message that a log has after an offset, or its last line."""
    with open(log, "rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(start_offset, file.tell() - MAX_LOG_TAIL_BYTES))
        lines = [line.strip() for line in file.read().decode("utf-8", "replace").splitlines() if line.strip()]
    errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error: ")]
    return (errors or lines or [""])[-1][:2000]
