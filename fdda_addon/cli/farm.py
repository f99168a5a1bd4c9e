# SPDX-License-Identifier: GPL-3.0-or-later
"""`farm characters.toml …`: starts the farm in a separate process, which parses the options.

The farm records and trains many characters. It is no part of the extension, because it never runs inside Blender.
"""

import os
import subprocess
import sys

from ..core.child_process import child_environment
from ..core.errors import FDDAError
from ..training.environment.folder import ROOT


def run(arguments: list[str]) -> int:
    """Run the farm; return its exit status.

    Raises:
        FDDAError: this installation has no farm.
    """
    if not _has_farm():
        raise FDDAError(
            "The farm is no part of the extension; run it from the project: python -m fdda_addon farm PLAN."
        )
    command, environment = _farm_command(arguments)
    return subprocess.run(command, env=environment, check=False).returncode


def replace_process_with_farm(arguments: list[str]) -> None:
    """Replace this process with the farm, so that the farm receives signals. Return if that is not possible."""
    # On Windows this process would end at once, and the farm would continue in the background.
    if os.name == "posix" and _has_farm():
        command, environment = _farm_command(arguments)
        os.execve(command[0], command, environment)


def _has_farm() -> bool:
    return (ROOT / "farm" / "__main__.py").is_file()


def _farm_command(arguments: list[str]) -> tuple[list[str], dict[str, str]]:
    return [sys.executable, "-P", "-m", "farm", *arguments], child_environment(ROOT)
