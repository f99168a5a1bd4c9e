# SPDX-License-Identifier: GPL-3.0-or-later
"""What a verb of the command line prints."""

import io
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass

from .conftest import run


@dataclass(frozen=True)
class CommandOutput:
    """What a command printed, a list of lines each."""

    out: list[str]
    err: list[str]


def output_of(*arguments: object) -> CommandOutput:
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        assert run(*arguments) == 0
    return CommandOutput(out.getvalue().splitlines(), err.getvalue().splitlines())
