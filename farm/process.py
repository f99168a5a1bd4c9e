# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a verb in a process of its own, and says how it ended."""

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
ENDED_BY_SIGNAL = 128
SENTENCE_BYTES = 64 << 10
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
ENGINES_OWN = ("MALLOC_TRIM_THRESHOLD_",)
"""What Dask sets for its workers and a verb is not to inherit. With it freed memory above 64 kB goes back to the
system, and comes back page by page: a training takes a fifth longer, an evaluation of 50,618 vertices a third."""
POSIX_MB = 1024 if sys.platform != "darwin" else 1024 * 1024
"""What the system counts peak memory in, in parts of a MB: kB on Linux, bytes on macOS."""


class VerbError(FDDAError):
    """A verb failed, and will fail again."""


class TryAgainError(FDDAError):
    """A verb failed for a reason of the machine's."""

    exit_status = TRY_AGAIN


@dataclass(frozen=True)
class ProcessResult:
    """What a verb took: wall-clock time, and the most memory of a process of it."""

    seconds: float
    peak_mb: float


@contextlib.contextmanager
def held(path: Path) -> Iterator[int]:
    """Hold the lock of a task; waits for it. Yields its file descriptor, for the processes that hold it as well.

    The system frees it when the last process that has it is gone. A verb whose worker was killed goes on and holds it:
    whoever is told to do the same task waits for it here, and finds it done.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield descriptor
    finally:
        os.close(descriptor)


def verb_command(farm: Farm, verb: tuple[str, ...]) -> list[str]:
    """The command line of a verb, for `subprocess`."""
    if farm.blender and verb[0] not in ("train", "merge-recordings"):
        return [farm.blender, "--command", "fdda", *verb]
    return [farm.python or sys.executable, "-P", "-m", "fdda_addon", *verb]


def verb_environment(farm: Farm, verb: tuple[str, ...]) -> dict[str, str]:
    """The environment of a verb: that of this process without what Dask set, and a fixed number of threads."""
    is_training = verb[0] == "train"
    environment = {name: value for name, value in os.environ.items() if name not in ENGINES_OWN}
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), *_paths()])
    environment |= dict.fromkeys(THREADS, str(farm.threads) if is_training else "1")
    if farm.trainer_python:
        environment["FDDA_TRAINER_PYTHON"] = farm.trainer_python
    if is_training and not farm.gpu:
        environment["CUDA_VISIBLE_DEVICES"] = ""
    return environment


def _paths() -> list[str]:
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
        lock: a descriptor that its process holds as well (`held`).
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
            _end(process.pid)
            raise
    process.returncode = code = os.waitstatus_to_exitcode(status)
    if code < 0 or code > ENDED_BY_SIGNAL:
        # Of a verb that tidied up first, or of a shell around it.
        raise TryAgainError(f"{verb[0]} was ended by signal {-code if code < 0 else code - ENDED_BY_SIGNAL}.")
    if code:
        sentence = _sentence(log, begin) or f"{verb[0]} ended with status {code}; see '{log}'."
        raise (TryAgainError if code == TRY_AGAIN else VerbError)(sentence)
    return ProcessResult(time.monotonic() - started, usage.ru_maxrss / POSIX_MB)


def _wait(process: int, is_wanted: Callable[[], bool]) -> tuple[int, resource.struct_rusage]:
    """Wait for a verb; its status, and what it used."""
    is_asked = False
    while True:
        ended, status, usage = os.wait4(process, os.WNOHANG)
        if ended:
            return status, usage
        if not is_asked and not is_wanted():
            is_asked = True
            _end(process)
        time.sleep(WAIT_SECONDS)


def _end(process: int) -> None:
    """Ask a verb, and what it started, to end."""
    with contextlib.suppress(OSError):
        os.killpg(process, signal.SIGTERM)


def _sentence(log: Path, begin: int) -> str:
    """What a verb said last of its failure."""
    with open(log, "rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(begin, file.tell() - SENTENCE_BYTES))
        lines = [line.strip() for line in file.read().decode("utf-8", "replace").splitlines() if line.strip()]
    errors = [line.removeprefix("Error: ") for line in lines if line.startswith("Error: ")]
    return (errors or lines or [""])[-1][:2000]
