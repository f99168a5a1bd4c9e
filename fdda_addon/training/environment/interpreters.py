# SPDX-License-Identifier: GPL-3.0-or-later
"""Searches for Python interpreters from which the training environment can be created.

Every candidate is run, because it may be a shim of a version manager, or lack the module venv.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from ...core.files.child_process import child_options
from .folder import PINNED_REQUIREMENTS

TIMEOUT_SECONDS = 30.0
# The versions that Blender itself has come first.
PREFERRED_VERSIONS = ("3.13", "3.11", "3.12")
NO_DOWNLOAD_ENVIRONMENT = {"PYTHON_MANAGER_AUTOMATIC_INSTALL": "false"}
"""Environment variables that keep the launcher `py` from installing a missing Python."""

_PROBE_SCRIPT = """
import json, sys
missing = []
for name in ("ctypes", "ensurepip", "ssl", "venv"):
    try:
        __import__(name)
    except ImportError:
        missing.append(name)
print(json.dumps([list(sys.version_info[:2]), sys.maxsize > 2**32, missing, sys.executable]))
"""


@dataclass(frozen=True)
class Interpreter:
    """A Python interpreter that runs.

    Attributes:
        path: path of the executable.
        version: major and minor version.
        problem: why no environment can be created from it; empty if one can.
    """

    path: str
    version: tuple[int, int]
    problem: str

    def __str__(self) -> str:
        return f"'{self.path}' (Python {self.version[0]}.{self.version[1]})"


def find_interpreters(candidates: Iterator[list[str]] | None = None) -> Iterator[Interpreter]:
    """Yield each interpreter of this machine that runs, Blender's own first.

    Args:
        candidates: command lines to try; None for `default_candidates`.
    """
    yielded_paths = set()
    for command in default_candidates() if candidates is None else candidates:
        interpreter = query_interpreter(command)
        if interpreter is not None and os.path.realpath(interpreter.path) not in yielded_paths:
            yielded_paths.add(os.path.realpath(interpreter.path))
            yield interpreter


def query_interpreter(command: list[str]) -> Interpreter | None:
    """Run a command line, and return its interpreter; None if it starts no Python."""
    try:
        options = child_options()
        options["env"] |= NO_DOWNLOAD_ENVIRONMENT
        result = subprocess.run(
            [*command, "-I", "-c", _PROBE_SCRIPT], capture_output=True, timeout=TIMEOUT_SECONDS, check=True, **options
        )
        version, is_64_bit, missing, path = json.loads(result.stdout.splitlines()[-1])
    except (OSError, subprocess.SubprocessError, ValueError, TypeError, IndexError):
        return None
    problem = ""
    if tuple(version) not in PINNED_REQUIREMENTS:
        supported = ", ".join(f"{major}.{minor}" for major, minor in sorted(PINNED_REQUIREMENTS))
        problem = f"is none of {supported}"
    elif not is_64_bit:
        problem = "is not 64-bit"
    elif missing:
        problem = f"lacks the module {missing[0]}"
    return Interpreter(path, tuple(version), problem)


def default_candidates() -> Iterator[list[str]]:
    """Yield command lines that may start a Python: Blender's own, those on PATH, and those of Homebrew."""
    if sys.executable:
        yield [sys.executable]
    if os.name == "nt":
        yield from _windows_candidates()
        return
    # PATH lacks the folders of Homebrew and python.org in a Blender that was started from its icon.
    for folder in ("", "/opt/homebrew/bin/", "/usr/local/bin/"):
        yield from ([f"{folder}python{version}"] for version in PREFERRED_VERSIONS)
    # On macOS /usr/bin/python3 opens a dialog that installs the developer tools.
    if sys.platform != "darwin":
        yield from (["python3"], ["python"])


def _windows_candidates() -> Iterator[list[str]]:
    """Yield the launcher with each version, then the interpreters on PATH."""
    if launcher := _find_on_path("py.exe"):
        yield from ([launcher, f"-{version}"] for version in PREFERRED_VERSIONS)
    for name in (*(f"python{version}.exe" for version in PREFERRED_VERSIONS), "python3.exe", "python.exe"):
        if program := _find_on_path(name):
            yield [program]


def _find_on_path(name: str) -> str:
    """Return the path of a program on PATH; empty if there is none. The current folder is not searched.

    Programs of the Microsoft Store are left out. Its python.exe may only open the store. If Python is installed from
    the store, Windows redirects what it writes to AppData, and so the environment.
    """
    for folder in map(Path, filter(None, os.environ.get("PATH", "").split(os.pathsep))):
        if folder.is_absolute() and (folder / name).is_file() and "windowsapps" not in map(str.lower, folder.parts):
            return str(folder / name)
    return ""
