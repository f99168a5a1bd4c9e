# SPDX-License-Identifier: GPL-3.0-or-later
"""Results of the last check of the trainer's Python in this session, which panels draw without running a check."""

from .check_result import CheckResult
from .folder import FolderState, environment_folder, folder_state

check_result: CheckResult | None = None
"""Result of the last check; None before the first check of the session."""
notice: CheckResult | None = None
"""Result of the last installation or removal of the environment, if it was not checked afterwards."""
_folder_state: FolderState | None = None


def store_result(new_result: CheckResult | None, new_notice: CheckResult | None = None) -> None:
    """Store results, and clear the cached state of the environment's folder."""
    global check_result, notice, _folder_state
    check_result, notice, _folder_state = new_result, new_notice, None


def environment_state() -> FolderState:
    """Return the state of the add-on's environment, from the cache if possible."""
    global _folder_state
    if _folder_state is None:
        _folder_state = folder_state(environment_folder())
    return _folder_state
