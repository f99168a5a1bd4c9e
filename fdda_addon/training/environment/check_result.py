# SPDX-License-Identifier: GPL-3.0-or-later
"""What panels, operators and the command line say of the trainer's Python."""

from typing import NamedTuple


class CheckResult(NamedTuple):
    """What is known of a Python, or how something ended.

    Attributes:
        level: 'INFO' all is well, 'WARNING' it works but should be seen to, 'ERROR' it does not work: the levels of an
            operator's report.
        message: one sentence; where it is not well, what to do.
        details: lines for those who want to know more.
    """

    level: str
    message: str
    details: tuple[str, ...] = ()
