# SPDX-License-Identifier: GPL-3.0-or-later
"""Running of a verb in its own process."""

import contextlib
import fcntl
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

from fdda_addon.core.errors import TRY_AGAIN, FDDAError

from .characters import Farm
from .fingerprints import ROOT

WAIT_SECONDS = 0.05
SIGNAL_STATUS_OFFSET = 128
MAX_LOG_TAIL_BYTES = 64 << 10
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
DASK_VARIABLES = ("MALLOC_TRIM_THRESHOLD_",)
"""What Dask sets for its workers and a verb is not to inherit. With it freed memory above 64 kB goes back to the
system, and comes back page by page: a training takes a fifth longer, an evaluation of 50,618 vertices a third."""
MAXRSS_PER_MB = 1024 if sys.platform != "darwin" else 1024 * 1024
"""What the system counts peak memory in, in parts of a MB: kB on Linux, bytes on macOS."""


class VerbError(FDDAError):
    """A verb failed, and will fail again."""


class TryAgainError(FDDAError):
    """A verb failed because of the machine."""

    exit_status = TRY_AGAIN


@dataclass(frozen=True)
class ProcessResult:
    """Wall-clock time of a verb, and the largest memory of its processes."""

    seconds: float
    peak_mb: float


@contextlib.contextmanager
def hold_lock(path: Path) -> Iterator[int]:
    """Wait for the lock of a task and hold it; yield its file descriptor, which child processes inherit.

    The system releases the lock when its last process ends. A verb whose worker was killed keeps running and holds the
    lock. Another worker with the same task waits for the lock and finds the task done.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
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
    environment = {name: value for name, value in os.environ.items() if name not in DASK_VARIABLES}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), *_inherited_paths()])
    environment |= dict.fromkeys(THREAD_VARIABLES, str(farm.threads) if is_training else "1")
    if farm.trainer_python:
        environment["FDDA_TRAINER_PYTHON"] = farm.trainer_python
    if is_training and not farm.gpu:
        environment["CUDA_VISIBLE_DEVICES"] = ""
    return environment


def _inherited_paths() -> list[str]:
    return [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path and path != str(ROOT)]


def run_verb(
    farm: Farm, verb: tuple[str, ...], folder: Path, log: Path, lock: int, is_wanted: Callable[[], bool] = lambda: True
) -> ProcessResult:
    """Run a verb until it ends.

    Args:
        farm: how it is run.
        verb: its name and options.
        folder: that relative paths are in.
        log: what it prints is added to this file.
        lock: a descriptor that its process holds as well (`hold_lock`).
        is_wanted: asked now and then; the verb is ended once it says no.

    Raises:
        VerbError: it failed, with its own sentence.
        TryAgainError: the machine is to blame, or a signal ended it.
    """
    command = verb_command(farm, verb)
    started = time.monotonic()
    with open(log, "ab") as output:
        output.write(f"$ {shlex.join(verb)}\n".encode())
        output.flush()
        begin = output.tell()
        try:
            process = subprocess.Popen(
                command,
                cwd=folder,
                env=verb_environment(farm, verb),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                pass_fds=(lock,),
                # Ctrl-C is for whoever started the farm; it ends what it started itself.
                start_new_session=True,
            )
        except OSError as error:
            raise VerbError(f"'{command[0]}' cannot be started ({error.strerror}); see [farm] in the plan.") from error
        try:
            status, usage = _wait(process.pid, is_wanted)
        except BaseException:
            _terminate(process.pid)
            raise
    process.returncode = code = os.waitstatus_to_exitcode(status)
    if code < 0 or code > SIGNAL_STATUS_OFFSET:
        # Of a verb that tidied up first, or of a shell around it.
        raise TryAgainError(f"{verb[0]} was ended by signal {-code if code < 0 else code - SIGNAL_STATUS_OFFSET}.")
    if code:
        sentence = _last_error_line(log, begin) or f"{verb[0]} ended with status {code}; see '{log}'."
        raise (TryAgainError if code == TRY_AGAIN else VerbError)(sentence)
    return ProcessResult(time.monotonic() - started, usage.ru_maxrss / MAXRSS_PER_MB)


def _wait(process: int, is_wanted: Callable[[], bool]) -> tuple[int, resource.struct_rusage]:
    """Wait for a verb; return its status and resource usage."""
    is_terminated = False
    while True:
        ended, status, usage = os.wait4(process, os.WNOHANG)
        if ended:
            return status, usage
        if not is_terminated and not is_wanted():
            is_terminated = True
            _terminate(process)
        time.sleep(WAIT_SECONDS)


def _terminate(process: int) -> None:
    """Send SIGTERM to a verb and its child processes."""
    with contextlib.suppress(OSError):
        os.killpg(process, signal.SIGTERM)


def _last_error_line(log: Path, begin: int) -> str:
    """Return the last error line of a log."""
    with open(log, "rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(begin, file.tell() - MAX_LOG_TAIL_BYTES))
        lines = [line.strip() for line in file.read().decode("utf-8", "replace").splitlines() if line.strip()]
    errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error: ")]
    return (errors or lines or [""])[-1][:2000]
