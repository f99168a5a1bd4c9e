# SPDX-License-Identifier: GPL-3.0-or-later
"""Entry point of the farm as a file, for engines that set no environment: `python farm/launch.py …`."""

import sys
from pathlib import Path

# The folder of this file may hold names of the standard library; the project's does not.
sys.path[0] = str(Path(__file__).resolve().parent.parent)

if __name__ == "__main__":
    from farm.__main__ import program

    program()
