# SPDX-License-Identifier: GPL-3.0-or-later
"""Entry point of the farm for engines that cannot set `PYTHONPATH`: `python farm/launch.py …`."""

import sys
from pathlib import Path

# Python puts the folder of this file on the path, whose modules could hide modules of the standard library.
sys.path[0] = str(Path(__file__).resolve().parent.parent)

if __name__ == "__main__":
    from farm.__main__ import run_program

    run_program()
