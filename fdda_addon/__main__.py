# SPDX-License-Identifier: GPL-3.0-or-later
"""`python -m fdda_addon VERB …`: the verbs with the bpy module, without Blender's program."""

import sys

from .core.stop_signals import exit_on_stop_signal

if __name__ == "__main__":
    exit_on_stop_signal()
    from .cli.main import main
    from .core.terminal import restart_in_utf8_mode

    restart_in_utf8_mode()
    if sys.argv[1:2] == ["farm"]:
        from .cli.farm import replace_process_with_farm

        replace_process_with_farm(sys.argv[2:])
    sys.exit(main(sys.argv[1:], "python -m fdda_addon"))
