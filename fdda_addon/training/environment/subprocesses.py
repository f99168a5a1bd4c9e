# SPDX-License-Identifier: GPL-3.0-or-later
"""Options for every process that the add-on starts, on all systems."""

import os
import subprocess

UTF8_OUTPUT = {"PYTHONIOENCODING": "utf-8:backslashreplace"}
"""Environment of a Python whose output is read here: on Windows a pipe has the code page of the country otherwise."""


def popen_options(*, own_session: bool = False) -> dict:
    """Options of `subprocess` that keep Windows from opening a console window.

    Args:
        own_session: Ctrl-C in the terminal of this process is not for that one, nor does it end with the terminal.
    """
    if os.name != "nt":
        return {"start_new_session": own_session}
    group = subprocess.CREATE_NEW_PROCESS_GROUP if own_session else 0
    return {"creationflags": subprocess.CREATE_NO_WINDOW | group}


def clean_environment() -> dict[str, str]:
    """This process's environment without what would lead another Python to wrong modules."""
    wrong = {"PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP", "VIRTUAL_ENV", "__PYVENV_LAUNCHER__"}
    return {name: value for name, value in os.environ.items() if name not in wrong} | UTF8_OUTPUT
