# SPDX-License-Identifier: GPL-3.0-or-later
"""Results of the last check of the trainer's Python in this session, which panels draw without running a check."""

from ...scene import draw_cache
from .check import CheckResult
from .folder import FolderState, environment_folder, folder_state

check_result: CheckResult | None = None
"""Result of the last check; None before the first check of the session."""
notice: CheckResult | None = None
"""Result of the last installation or removal of the environment, if it was not checked afterwards."""


def store_result(new_result: CheckResult | None, new_notice: CheckResult | None = None) -> None:
    """Store results, and let panels read the state of the environment's folder again."""
    global check_result, notice
    check_result, notice = new_result, new_notice
    draw_cache.clear()


@draw_cache.draw_cached
def environment_state() -> FolderState:
    """Return the state of the add-on's environment, cached for drawing."""
    return folder_state(environment_folder())
