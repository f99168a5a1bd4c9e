# SPDX-License-Identifier: GPL-3.0-or-later
"""Finds a Python that the trainer's environment can be made from.

A name proves nothing: it may start a version manager's shim for a Python that was not selected, or a Python without its
venv module. So every candidate is run.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from .check import hidden
from .folder import PINS

TIMEOUT_SECONDS = 30.0
# Newest first, but those that Blender itself has before the one between.
VERSIONS = ("3.13", "3.11", "3.12")

_QUESTION = """
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
class BasePython:
    """A Python that runs: its path, version, and what it lacks to make an environment, empty for nothing."""

    path: str
    version: tuple[int, int]
    lacks: str

    def __str__(self) -> str:
        return f"'{self.path}' (Python {self.version[0]}.{self.version[1]})"


def find_bases(candidates: Iterator[list[str]] | None = None) -> Iterator[BasePython]:
    """The Pythons of this machine that run, each once, Blender's own first.

    Args:
        candidates: command lines to try, the usual places when left out.
    """
    seen = set()
    for command in usual_candidates() if candidates is None else candidates:
        base = ask(command)
        if base is not None and os.path.realpath(base.path) not in seen:
            seen.add(os.path.realpath(base.path))
            yield base


def ask(command: list[str]) -> BasePython | None:
    """What a command line starts; None when that is no Python."""
    try:
        result = subprocess.run(
            [*command, "-I", "-c", _QUESTION],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=TIMEOUT_SECONDS,
            env=clean_environment(),
            check=True,
            **hidden(),
        )
        version, is_64_bit, missing, path = json.loads(result.stdout.decode("utf-8", "replace").splitlines()[-1])
    except (OSError, subprocess.SubprocessError, ValueError, TypeError, IndexError):
        return None
    lacks = ""
    if tuple(version) not in PINS:
        known = ", ".join(f"{major}.{minor}" for major, minor in sorted(PINS))
        lacks = f"is none of {known}"
    elif not is_64_bit:
        lacks = "is not 64-bit"
    elif missing:
        lacks = f"lacks the module {missing[0]}"
    return BasePython(path, tuple(version), lacks)


def usual_candidates() -> Iterator[list[str]]:
    """Command lines that may start a Python: Blender's own, those on the path, those of installers."""
    if sys.executable:
        yield [sys.executable]
    for version in VERSIONS:
        yield [f"python{version}"]
        if os.name == "nt":
            yield ["py", f"-{version}"]
    # On macOS the name in /usr/bin asks to install the developer tools.
    if sys.platform != "darwin":
        yield from (["python3"], ["python"])
    home = Path.home()
    pyenv = Path(os.environ.get("PYENV_ROOT") or home / ".pyenv")
    data = Path(os.environ.get("XDG_DATA_HOME") or home / ".local/share")
    for version in VERSIONS:
        for place in (
            *sorted(pyenv.glob(f"versions/{version}.*/bin/python")),
            *sorted(data.glob(f"uv/python/cpython-{version}.*/bin/python")),
            *(Path(folder) / f"python{version}" for folder in ("/opt/homebrew/bin", "/usr/local/bin", "/usr/bin")),
            Path(f"/Library/Frameworks/Python.framework/Versions/{version}/bin/python{version}"),
        ):
            if place.is_file():
                yield [str(place)]


def clean_environment() -> dict[str, str]:
    """This process's environment without what would lead another Python to wrong modules."""
    wrong = {"PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP", "VIRTUAL_ENV", "__PYVENV_LAUNCHER__"}
    return {name: value for name, value in os.environ.items() if name not in wrong}
