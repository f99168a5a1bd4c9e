# SPDX-License-Identifier: GPL-3.0-or-later
"""Options of `subprocess` for the processes that the add-on starts."""

import os
import subprocess

UTF8_OUTPUT = {"PYTHONIOENCODING": "utf-8:backslashreplace"}
"""Environment variable for a Python whose output is read. Without it pipes on Windows use the local code page."""


def popen_options(*, own_session: bool = False) -> dict:
    """Return options of `subprocess` that open no console window on Windows.

    Args:
        own_session: whether the process continues after Ctrl-C in the terminal, and after the terminal is closed.
    """
    if os.name != "nt":
        return {"start_new_session": own_session}
    group = subprocess.CREATE_NEW_PROCESS_GROUP if own_session else 0
    return {"creationflags": subprocess.CREATE_NO_WINDOW | group}


def clean_environment() -> dict[str, str]:
    """Return this process's environment without variables that change the imports of another Python."""
    import_variables = {"PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP", "VIRTUAL_ENV", "__PYVENV_LAUNCHER__"}
    return {name: value for name, value in os.environ.items() if name not in import_variables} | UTF8_OUTPUT
