# SPDX-License-Identifier: GPL-3.0-or-later
"""Result of a check of the trainer's Python, for panels, operators and the command line."""

from typing import NamedTuple


class CheckResult(NamedTuple):
    """Result of a check, or of an operation on the environment.

    Attributes:
        level: 'INFO', 'WARNING' (works, but needs attention) or 'ERROR' (does not work), as in operator reports.
        message: one sentence; for a problem, with what to do.
        details: further lines.
    """

    level: str
    message: str
    details: tuple[str, ...] = ()
