# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs the command line as `python -m fdda_addon VERB …`, with the bpy module instead of Blender's program."""

import sys

from .core.files.stop_signals import exit_on_stop_signal

if __name__ == "__main__":
    exit_on_stop_signal()
    from .cli.main import main

    sys.exit(main(sys.argv[1:], "python -m fdda_addon"))
