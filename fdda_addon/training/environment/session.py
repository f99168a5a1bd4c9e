# SPDX-License-Identifier: GPL-3.0-or-later
"""What this session knows of the trainer's Python: for panels to draw.

Nothing here is asked while drawing; `answer` is what the last check said.
"""

from .answer import Answer
from .folder import FolderState, folder_state, own_folder

answer: Answer | None = None
"""What the last check of the trainer's Python said; None: not checked in this session."""
notice: Answer | None = None
"""How the last creation or removal ended, when it did not end in an answer."""
_folder_state: FolderState | None = None


def remember(new_answer: Answer | None, new_notice: Answer | None = None) -> None:
    """Keep what was found out, and look at the environment's folder anew when it is next drawn."""
    global answer, notice, _folder_state
    answer, notice, _folder_state = new_answer, new_notice, None


def own_state() -> FolderState:
    """The state of the add-on's own environment as this session knows it."""
    global _folder_state
    if _folder_state is None:
        _folder_state = folder_state(own_folder())
    return _folder_state
