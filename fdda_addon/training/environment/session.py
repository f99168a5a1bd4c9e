# SPDX-License-Identifier: GPL-3.0-or-later
"""State of the trainer's Python in this session, which panels draw without running a check."""

from .check_result import CheckResult
from .folder import FolderState, environment_folder, folder_state

check_result: CheckResult | None = None
"""Result of the last check; None where it was not checked in this session."""
notice: CheckResult | None = None
"""Result of the last creation or removal without a check."""
_folder_state: FolderState | None = None


def store_result(new_result: CheckResult | None, new_notice: CheckResult | None = None) -> None:
    """Store results, and read the state of the environment's folder again when it is drawn."""
    global check_result, notice, _folder_state
    check_result, notice, _folder_state = new_result, new_notice, None


def environment_state() -> FolderState:
    """Return the cached state of the add-on's environment."""
    global _folder_state
    if _folder_state is None:
        _folder_state = folder_state(environment_folder())
    return _folder_state
