# SPDX-License-Identifier: GPL-3.0-or-later
"""Installs the training environment, a virtual environment with pinned package versions, and writes a log."""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO

from ...core.errors import TrainerEnvironmentError, os_error_text
from ...core.files.child_process import child_options
from ...core.files.path_limits import path_length_problem
from ...core.progress import Job, Progress
from .check import CheckResult, check
from .folder import (
    PACKAGES,
    PINNED_REQUIREMENTS,
    creation_lock,
    interpreter_path,
    remove_environment,
    requirements_file,
    site_packages,
    write_completion_marker,
)

RUN_PIP = Path(__file__).with_name("run_pip.py")
UNREADABLE_SETTINGS_STATUS = 78
"""Exit status of `RUN_PIP` if pip's settings cannot be read: EX_CONFIG of sysexits.h."""
MAX_WHEEL_PATH_LENGTH = 126
"""Length of the longest path in the wheels for Windows, a license file of torch 2.15.0."""
MIN_FREE_GB = 9 if sys.platform.startswith("linux") else 2
"""Free disk space that the packages and downloads need. On Linux they include CUDA."""


class EnvironmentCreation:
    """Installation of the training environment. `steps` installs it; `cancel` cancels from another thread.

    Args:
        folder: folder of the environment. An existing environment is removed first.
        log: file for the output of all commands.
        wheels: folder of wheels; None for the package index in the settings of pip.
    """

    def __init__(self, folder: Path, log: Path, wheels: Path | None = None):
        self.folder, self.log, self.wheels = folder, log, wheels
        self._lock = threading.Lock()
        self._process: subprocess.Popen | None = None
        self._cancelled = False
        self._last_lines: list[str] = []
        self._has_changed_folder = False

    def steps(self) -> Job[CheckResult]:
        """Install the environment, and return the result of its check.

        Raises:
            TrainerEnvironmentError: the installation failed or was canceled, and the folder was removed.
        """
        try:
            return (yield from self._steps())
        except OSError as error:
            raise TrainerEnvironmentError(
                f"The training environment cannot be written ({os_error_text(error)}: "
                f"'{error.filename or self.folder}'); make room or check the permissions, and install it again."
            ) from error

    def _steps(self) -> Job[CheckResult]:
        with creation_lock(self.folder), self.log.open("w", encoding="utf-8") as log:
            _check_source(self.folder, self.wheels)
            python, version = sys.executable, sys.version_info[:2]
            python_name = f"'{python}' (Python {version[0]}.{version[1]})"
            if version not in PINNED_REQUIREMENTS:
                raise self._no_python_error(f"{python_name} is too new")
            complete = False
            try:
                yield Progress("removing what was there", 0, 0)
                self._stop_if_cancelled()
                self._has_changed_folder = True
                remove_environment(self.folder)
                yield Progress(f"making it from {python_name}", 0, 0)
                if (yield from self._run([python, "-I", "-m", "venv", "--clear", str(self.folder)], log)):
                    raise self._no_python_error(f"{python_name}: {self._error_line()}")
                # On the disk, because /tmp may be in memory; on Windows with a short path.
                place = None if os.name == "nt" else self.folder
                with tempfile.TemporaryDirectory(prefix="fdda-", dir=place, ignore_cleanup_errors=True) as temporary:
                    yield from self._install_with(temporary, version, log)
                yield Progress("checking", 0, 0)
                result = check(str(interpreter_path(self.folder)), f"the log is '{self.log}'")
                log.writelines(f"{line}\n" for line in (result.message, *result.details))
                self._stop_if_cancelled()
                if result.level == "ERROR":
                    raise TrainerEnvironmentError(f"The packages were installed but do not work: {result.message}")
                write_completion_marker(self.folder, version)
                complete = True
            finally:
                if self._has_changed_folder and not complete:
                    remove_environment(self.folder)
        return result

    def cancel(self) -> None:
        """Cancel the installation. Thread-safe."""
        with self._lock:
            self._cancelled = True
            if self._process is not None:
                _kill(self._process)

    def _no_python_error(self, reason: str) -> TrainerEnvironmentError:
        return TrainerEnvironmentError(
            f"The training environment cannot be created ({reason}); choose an existing Python that has torch. The log "
            f"is '{self.log}'."
        )

    def _install_with(self, temporary: str, version: tuple[int, int], log: IO[str]) -> Iterator[Progress]:
        packages = site_packages(self.folder, version)
        # Packages are installed into the folder itself, because paths in site-packages are 18 characters longer.
        # This .pth file makes Python import from there.
        (packages / "fdda.pth").write_text(os.path.relpath(self.folder, packages) + "\n", encoding="ascii")
        command = [str(interpreter_path(self.folder)), "-I", str(RUN_PIP), "install"]
        command += ["--no-input", "--disable-pip-version-check", "--no-cache-dir"]
        command += ["--target", str(self.folder)]
        command += ["--only-binary=:all:", "--constraint", str(requirements_file(version)), *PACKAGES]
        if self.wheels is not None:
            command += ["--no-index", "--find-links", str(self.wheels)]
        status = yield from self._run(command, log, dict.fromkeys(("TMPDIR", "TEMP", "TMP"), temporary))
        if status == UNREADABLE_SETTINGS_STATUS:
            raise TrainerEnvironmentError(
                f"The settings of pip cannot be read ({self._error_line()}); correct or remove that file."
            )
        if status != 0:
            source = f"of '{self.wheels}'" if self.wheels else "of the package index"
            advice = (
                "add what is missing"
                if self.wheels
                else "does the index have them, is this machine online, the disk full?"
            )
            raise TrainerEnvironmentError(
                f"The packages {source} could not be installed ({self._error_line()}); {advice}; the log is "
                f"'{self.log}'."
            )

    def _run(self, command: list[str], log: IO[str], variables: Mapping[str, str] = {}) -> Job[int]:
        """Run a command with further environment variables, and return its exit status.

        Its current folder is outside of the environment, which Windows could not remove otherwise.
        """
        log.write(f"$ {subprocess.list2cmdline(command)}\n")
        self._last_lines = []
        options = child_options(own_session=True)
        options["env"] |= variables
        with self._lock:
            self._stop_if_cancelled()
            try:
                self._process = process = subprocess.Popen(
                    command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=self.folder.parent, **options
                )
            except OSError as error:
                self._last_lines.append(str(error))
                return 1
        try:
            for line in process.stdout:
                yield from self._log_line(line.strip(), log)
            status = process.wait()
        finally:
            with self._lock:
                if process.poll() is None:
                    _kill(process)
                self._process = None
            process.stdout.close()
            process.wait()
        self._stop_if_cancelled()
        return status

    def _log_line(self, line: str, log: IO[str]) -> Iterator[Progress]:
        """Write an output line to the log, and yield its progress."""
        if match := re.fullmatch(r"Progress (\d+) of (\d+)", line):
            done, total = (int(number) // 1_000_000 for number in match.groups())
            yield Progress(self._last_lines[-1] if self._last_lines else "downloading", done, total)
        elif line:
            log.write(f"{line}\n")
            log.flush()
            self._last_lines = [*self._last_lines[-20:], line]
            yield Progress(line, 0, 0)

    def _error_line(self) -> str:
        """Return the output line that explains a failure best: pip's last error that is no link to its manual."""
        errors = [line for line in self._last_lines if re.match("error:", line, re.IGNORECASE) and "http" not in line]
        return (errors or self._last_lines or ["there was no output"])[-1].removeprefix("ERROR: ").rstrip(".")

    def _stop_if_cancelled(self) -> None:
        if self._cancelled:
            state = "nothing was kept" if self._has_changed_folder else "the previous environment was kept"
            raise TrainerEnvironmentError(f"The installation of the training environment was canceled; {state}.")


def _check_source(folder: Path, wheels: Path | None) -> None:
    """Check the lengths of the paths in an environment, and the free space for downloads or the folder of wheels.

    Raises:
        TrainerEnvironmentError: paths would be too long, the disk is too full, or there is no folder of wheels.
    """
    if problem := path_length_problem(folder / ("x" * MAX_WHEEL_PATH_LENGTH)):
        raise TrainerEnvironmentError(
            f"The training environment cannot be in '{folder}' ({problem}); allow long paths "
            "(https://pip.pypa.io/warnings/enable-long-paths), or choose an existing Python that has torch."
        )
    if wheels is None:
        free_gb = shutil.disk_usage(folder.parent).free / 1e9
        if free_gb < MIN_FREE_GB:
            raise TrainerEnvironmentError(
                f"The training environment needs {MIN_FREE_GB} GB and '{folder.parent}' has {free_gb:.1f} GB "
                "left; make room, or choose an existing Python that has torch."
            )
    elif not wheels.is_dir():
        raise TrainerEnvironmentError(f"'{wheels}' is no folder; choose the folder that holds the packages.")


def _kill(process: subprocess.Popen) -> None:
    """Kill the process of a command, and its child processes."""
    if process.poll() is not None:
        return
    if os.name == "nt":
        # The module venv starts another Python, which would continue.
        subprocess.run(
            ["taskkill", "/F", "/T", "/PID", str(process.pid)], capture_output=True, check=False, **child_options()
        )
        process.kill()
    else:
        os.killpg(process.pid, signal.SIGKILL)
