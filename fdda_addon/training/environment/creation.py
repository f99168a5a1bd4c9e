# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the add-on's own training environment: a virtual environment with the pinned packages, and a log of it."""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from ...core.errors import TrainerEnvironmentError, os_error_text
from ...core.progress import Progress
from .check import check
from .check_result import CheckResult
from .folder import (
    PACKAGES,
    claimed,
    has_path_limit,
    missing_letters,
    pins,
    python_in,
    remove,
    site_packages,
    write_mark,
)
from .interpreters import Interpreter, ask, find_interpreters
from .subprocesses import clean_environment, hidden

NEEDED_GB = 9 if sys.platform.startswith("linux") else 2
"""Free space to begin with: the packages and the downloads, which lie there at the same time. On Linux with CUDA."""
TEMPORARY = "fdda-12345678"
"""Such is the name of the folder for temporary files on Windows."""
PIP_WITH_RAW_PROGRESS = (24, 1)


class Creation:
    """The creation of an environment; `steps` does it, `cancel` ends it from another thread.

    Args:
        folder: of the environment; what is there is removed first.
        log: file that gets what the steps print, written anew.
        wheels: folder of wheels to install from; the package index of pip's settings when left out.
        base: path of the Python to make it from; a suitable one is looked for when left out.
    """

    def __init__(self, folder: Path, log: Path, wheels: Path | None = None, base: str = ""):
        self.folder, self.log, self.wheels, self.base = folder, log, wheels, base
        self._lock = threading.Lock()
        self._process: subprocess.Popen | None = None
        self._cancelled = False
        self._last_lines: list[str] = []
        self._has_begun = False

    def steps(self) -> Iterator[Progress | CheckResult]:
        """Make the environment; yields how far it is, and last the answer of its Python.

        Raises:
            TrainerEnvironmentError: it cannot be made, and nothing is left of it. Also when the user cancelled.
        """
        try:
            yield from self._steps()
        except OSError as error:
            raise TrainerEnvironmentError(
                f"The training environment cannot be written ({os_error_text(error)}: "
                f"'{error.filename or self.folder}'); make room or check the permissions, and install it again."
            ) from error

    def _steps(self) -> Iterator[Progress | CheckResult]:
        with claimed(self.folder), _written(self.log) as log:
            self._check_source()
            yield Progress("looking for a Python", 0, 0)
            bases = self._find_interpreters(log)
            if self.wheels is not None:
                self._check_wheels(bases[0], log)
            complete = False
            try:
                yield Progress("removing what was there", 0, 0)
                self._stop_if_cancelled()
                self._has_begun = True
                remove(self.folder)
                base = yield from self._make(bases, log)
                yield from self._install(base, log)
                yield Progress("checking", 0, 0)
                answer = self._check(log)
                write_mark(self.folder, base.version)
                complete = True
            finally:
                if self._has_begun and not complete:
                    remove(self.folder)
        yield answer

    def cancel(self) -> None:
        """End it soon. From any thread."""
        with self._lock:
            self._cancelled = True
            if self._process is not None:
                _end(self._process)

    def _check_source(self) -> None:
        if has_path_limit() and (letters := missing_letters(self.folder, Path(tempfile.gettempdir(), TEMPORARY))):
            raise TrainerEnvironmentError(
                f"Paths in the training environment '{self.folder}' would be {letters} letters too long for Windows; "
                "allow long paths (https://pip.pypa.io/warnings/enable-long-paths), or choose an existing Python that "
                "has torch."
            )
        if self.wheels is None:
            free = shutil.disk_usage(self.folder.parent).free / 1e9
            if free < NEEDED_GB:
                raise TrainerEnvironmentError(
                    f"The training environment needs {NEEDED_GB} GB and '{self.folder.parent}' has {free:.1f} GB left; "
                    "make room, or choose an existing Python that has torch."
                )
        elif not self.wheels.is_dir():
            raise TrainerEnvironmentError(f"'{self.wheels}' is no folder; choose the folder that holds the packages.")

    def _check_wheels(self, base: Interpreter, log: IO[str]) -> None:
        """Before what is there is removed: pip would find a missing wheel late, and call it a conflict of versions."""
        pinned = [line for line in pins(base.version).read_text(encoding="utf-8").splitlines() if "==" in line]
        wanted = [line.split("==") for line in pinned if line.partition("==")[0] in PACKAGES]
        missing = [
            f"{name} {version}" for name, version in wanted if not any(self.wheels.glob(f"{name}-{version}[-+]*.whl"))
        ]
        if missing:
            version = f"{base.version[0]}.{base.version[1]}"
            download = ["pip", "download", "--only-binary=:all:", f"--constraint={pins(base.version)}", "--dest=wheels"]
            log.write(f"With Python {version} on such a machine as this, but online:\n")
            log.write(f"$ {subprocess.list2cmdline([f'python{version}', '-m', *download, *PACKAGES])}\n")
            raise TrainerEnvironmentError(
                f"The folder '{self.wheels}' lacks the packages {', '.join(missing)} for Python {version}; download "
                f"them on a machine that is online, '{self.log}' has the command."
            )

    def _find_interpreters(self, log: IO[str]) -> list[Interpreter]:
        """The Pythons that may make it, the best first."""
        if self.base:
            asked = ask([self.base])
            if asked is None:
                raise TrainerEnvironmentError(f"'{self.base}' is no Python that runs; name another, or leave it out.")
            found = [asked]
        else:
            found = list(find_interpreters())
        log.writelines(f"{base} {base.lacks or 'can be tried'}\n" for base in found)
        suitable = [base for base in found if not base.lacks]
        self._stop_if_cancelled()
        if not suitable:
            raise self._no_python(f"{found[0]} {found[0].lacks}" if found else "none runs")
        return suitable

    def _make(self, bases: list[Interpreter], log: IO[str]) -> Iterator[Progress]:
        """Make the virtual environment from the first Python that can; returns that Python."""
        for base in bases:
            yield Progress(f"making it from {base}", 0, 0)
            command = [base.path, "-I", "-m", "venv", "--clear", str(self.folder)]
            if (yield from self._run(command, log)) == 0 and ask([str(python_in(self.folder))]) is not None:
                return base
        raise self._no_python(f"{bases[-1]}: {self._last_words()}")

    def _no_python(self, reason: str) -> TrainerEnvironmentError:
        return TrainerEnvironmentError(
            f"No Python on this machine can create the training environment ({reason}); install Python 3.13 with its "
            f"venv module, or choose an existing Python that has torch. '{self.log}' lists what was tried."
        )

    def _install(self, base: Interpreter, log: IO[str]) -> Iterator[Progress]:
        with self._temporary() as temporary:
            yield from self._install_with(temporary, base, log)

    @contextmanager
    def _temporary(self) -> Iterator[Path]:
        """A folder for gigabytes, more than a /tmp in memory holds. On Windows a short path counts for more."""
        if os.name == "nt":
            path = Path(tempfile.mkdtemp(prefix=TEMPORARY[:-8]))
        else:
            path = self.folder / "temporary"
            path.mkdir()
        try:
            yield path
        finally:
            shutil.rmtree(path, ignore_errors=True)

    def _install_with(self, temporary: Path, base: Interpreter, log: IO[str]) -> Iterator[Progress]:
        packages = site_packages(self.folder, base.version)
        # The folder itself, found through a .pth file: paths in site-packages would be 18 letters longer.
        (packages / "fdda.pth").write_text(os.path.relpath(self.folder, packages) + "\n", encoding="ascii")
        pip = [str(python_in(self.folder)), "-I", "-m", "pip"]
        command = [*pip, "install", "--no-input", "--disable-pip-version-check", "--no-cache-dir"]
        command += ["--target", str(self.folder)]
        command += ["--only-binary=:all:", "--constraint", str(pins(base.version)), *PACKAGES]
        if (yield from self._run([*pip, "--version"], log)) == 0:
            version = re.search(r"pip (\d+)\.(\d+)", "\n".join(self._last_lines))
            raw = version is not None and tuple(map(int, version.groups())) >= PIP_WITH_RAW_PROGRESS
            command.append(f"--progress-bar={'raw' if raw else 'off'}")
        if self.wheels is not None:
            command += ["--no-index", "--find-links", str(self.wheels)]
        if (yield from self._run(command, log, self._pip_environment(temporary))) != 0:
            what = f"of '{self.wheels}'" if self.wheels else "of the package index"
            then = "add what is missing" if self.wheels else "is this machine online, the disk full?"
            raise TrainerEnvironmentError(
                f"The packages {what} could not be installed ({self._last_words()}); {then}; the log is '{self.log}'."
            )

    def _pip_environment(self, temporary: Path) -> dict[str, str]:
        environment = clean_environment()
        if self.wheels is not None:
            # That folder and no other: pip's settings may name more.
            environment = {name: value for name, value in environment.items() if not name.startswith("PIP_")}
            environment["PIP_CONFIG_FILE"] = os.devnull
        return environment | dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(temporary))

    def _check(self, log: IO[str]) -> CheckResult:
        answer = check(str(python_in(self.folder)), f"the log is '{self.log}'")
        log.writelines(f"{line}\n" for line in (answer.message, *answer.details))
        self._stop_if_cancelled()
        if answer.level == "ERROR":
            raise TrainerEnvironmentError(f"The packages were installed but do not work: {answer.message}")
        return answer

    def _run(self, command: list[str], log: IO[str], environment: dict[str, str] | None = None) -> Iterator[Progress]:
        """Run one step; returns its exit status. Not in the folder itself: Windows would not let that be removed."""
        log.write(f"$ {subprocess.list2cmdline(command)}\n")
        self._last_lines = []
        with self._lock:
            self._stop_if_cancelled()
            try:
                self._process = process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    env=environment or clean_environment(),
                    cwd=self.folder.parent,
                    **hidden(own_session=True),
                )
            except OSError as error:
                self._last_lines.append(str(error))
                return 1
        try:
            for line in process.stdout:
                yield from self._note(line.decode("utf-8", "replace").strip(), log)
            status = process.wait()
        finally:
            with self._lock:
                if process.poll() is None:
                    _end(process)
                self._process = None
            process.stdout.close()
            process.wait()
        self._stop_if_cancelled()
        return status

    def _note(self, line: str, log: IO[str]) -> Iterator[Progress]:
        """Put a line that a step printed into the log, and yield what it says of the progress."""
        if match := re.fullmatch(r"Progress (\d+) of (\d+)", line):
            done, total = (int(number) // 1_000_000 for number in match.groups())
            yield Progress(self._last_lines[-1] if self._last_lines else "downloading", done, total)
        elif line:
            log.write(f"{line}\n")
            log.flush()
            self._last_lines = [*self._last_lines[-20:], line]
            yield Progress(line, 0, 0)

    def _last_words(self) -> str:
        """The line that says best why a step failed: pip's last error, but not the one that points to its manual."""
        errors = [line for line in self._last_lines if re.match("error:", line, re.IGNORECASE) and "http" not in line]
        return (errors or self._last_lines or ["it said nothing"])[-1].removeprefix("ERROR: ").rstrip(".")

    def _stop_if_cancelled(self) -> None:
        if self._cancelled:
            left = "nothing is left of it" if self._has_begun else "what was there stays"
            raise TrainerEnvironmentError(f"The installation of the training environment was canceled; {left}.")


@contextmanager
def _written(log: Path) -> Iterator[IO[str]]:
    """The log, opened to be written anew."""
    try:
        file = log.open("w", encoding="utf-8")
    except OSError as error:
        raise TrainerEnvironmentError(
            f"The log '{log}' cannot be written ({os_error_text(error)}); remove it."
        ) from error
    with file:
        yield file


def _end(process: subprocess.Popen) -> None:
    """End a step and what it started."""
    if process.poll() is not None:
        return
    if os.name == "nt":
        # The module venv starts a Python of its own, which would go on.
        subprocess.run(["taskkill", "/F", "/T", "/PID", str(process.pid)], capture_output=True, check=False, **hidden())
        process.kill()
    else:
        os.killpg(process.pid, signal.SIGKILL)
