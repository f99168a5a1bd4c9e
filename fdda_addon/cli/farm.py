# SPDX-License-Identifier: GPL-3.0-or-later
"""`farm characters.toml …`: many characters on many machines; the farm reads its own options, in a process of its own.

It is no part of the extension: it starts Blender, and never runs in it.
"""

import os
import subprocess
import sys

from ..core.errors import FDDAError
from ..training.environment.folder import ROOT


def run(arguments: list[str]) -> int:
    """Run the farm; returns its exit status.

    Raises:
        FDDAError: it is not there.
    """
    if not (ROOT / "farm" / "__main__.py").is_file():
        raise FDDAError(
            "The farm is no part of the extension; run it from the project: python -m fdda_addon farm PLAN."
        )
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    command = [sys.executable, "-P", "-m", "farm", *arguments]
    return subprocess.run(command, env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)}, check=False).returncode
