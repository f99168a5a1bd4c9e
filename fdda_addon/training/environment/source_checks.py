# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks before a training environment is created: its folder, the disk, and the wheels to install."""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO

from ...core.errors import TrainerEnvironmentError
from .folder import PACKAGES, excess_path_length, has_path_limit, requirements_file
from .interpreters import Interpreter

MIN_FREE_GB = 9 if sys.platform.startswith("linux") else 2
"""Free disk space that the packages and downloads need. On Linux they include CUDA."""
TEMPORARY_FOLDER_NAME = "fdda-12345678"
"""Name of the temporary folder on Windows, with an example of its random suffix."""


def check_source(folder: Path, wheels: Path | None) -> None:
    """Check that an environment can be created in a folder, from packages of the registry or from wheels.

    Raises:
        TrainerEnvironmentError: its paths would be too long, the disk is too full, or the wheels are not there.
    """
    if has_path_limit() and (excess := excess_path_length(folder, Path(tempfile.gettempdir(), TEMPORARY_FOLDER_NAME))):
        raise TrainerEnvironmentError(
            f"Paths in the training environment '{folder}' would be {excess} letters too long for Windows; "
            "allow long paths (https://pip.pypa.io/warnings/enable-long-paths), or choose an existing Python that "
            "has torch."
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


def check_wheels(wheels: Path, interpreter: Interpreter, log: IO[str], log_path: Path) -> None:
    """Check that no wheel is missing. pip would report one late, and as a version conflict.

    Raises:
        TrainerEnvironmentError: wheels are missing; the log has the command that downloads them.
    """
    pinned = [
        line for line in requirements_file(interpreter.version).read_text(encoding="utf-8").splitlines() if "==" in line
    ]
    pinned_versions = [line.split("==") for line in pinned if line.partition("==")[0] in PACKAGES]
    missing = [
        f"{name} {version}" for name, version in pinned_versions if not any(wheels.glob(f"{name}-{version}[-+]*.whl"))
    ]
    if missing:
        version = f"{interpreter.version[0]}.{interpreter.version[1]}"
        download = [
            "pip",
            "download",
            "--only-binary=:all:",
            f"--constraint={requirements_file(interpreter.version)}",
            "--dest=wheels",
        ]
        log.write(f"With Python {version} on such a machine as this, but online:\n")
        log.write(f"$ {subprocess.list2cmdline([f'python{version}', '-m', *download, *PACKAGES])}\n")
        raise TrainerEnvironmentError(
            f"The folder '{wheels}' lacks the packages {', '.join(missing)} for Python {version}; download "
            f"them on a machine that is online, '{log_path}' has the command."
        )
