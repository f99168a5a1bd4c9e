# SPDX-License-Identifier: GPL-3.0-or-later
"""What this session knows of the trainer's Python: for panels to draw.

Nothing here is asked while drawing; `check_result` is what the last check said.
"""

from .check_result import CheckResult
from .folder import FolderState, environment_folder, folder_state

check_result: CheckResult | None = None
"""What the last check of the trainer's Python said; None: not checked in this session."""
notice: CheckResult | None = None
"""How the last creation or removal ended, when it did not end in a check."""
_folder_state: FolderState | None = None


def store_result(new_result: CheckResult | None, new_notice: CheckResult | None = None) -> None:
    """Keep what was found out, and look at the environment's folder anew when it is next drawn."""
    global check_result, notice, _folder_state
    check_result, notice, _folder_state = new_result, new_notice, None


def environment_state() -> FolderState:
    """The state of the add-on's own environment as this session knows it."""
    global _folder_state
    if _folder_state is None:
        _folder_state = folder_state(environment_folder())
    return _folder_state
