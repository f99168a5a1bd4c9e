# SPDX-License-Identifier: GPL-3.0-or-later
"""`farm characters.toml …`: records and trains many characters; the farm parses its options in its own process.

It is no part of the extension: it starts Blender, and never runs in it.
"""

import os
import subprocess
import sys

from ..core.errors import FDDAError
from ..training.environment.folder import ROOT


def run(arguments: list[str]) -> int:
    """Run the farm; return its exit status.

    Raises:
        FDDAError: it is not there.
    """
    if not _is_there():
        raise FDDAError(
            "The farm is no part of the extension; run it from the project: python -m fdda_addon farm PLAN."
        )
    command, environment = _command(arguments)
    return subprocess.run(command, env=environment, check=False).returncode


def replace_process_with_farm(arguments: list[str]) -> None:
    """Replace this process with the farm, so that signals reach it; return where that is not possible."""
    # On Windows the program would end at once, and the farm go on without it.
    if os.name == "posix" and _is_there():
        command, environment = _command(arguments)
        os.execve(command[0], command, environment)


def _is_there() -> bool:
    return (ROOT / "farm" / "__main__.py").is_file()


def _command(arguments: list[str]) -> tuple[list[str], dict[str, str]]:
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return [sys.executable, "-P", "-m", "farm", *arguments], {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
