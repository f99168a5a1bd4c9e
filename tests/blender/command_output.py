# SPDX-License-Identifier: GPL-3.0-or-later
"""The output of a verb of the command line, as lines."""

import io
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass

from .conftest import run


@dataclass(frozen=True)
class CommandOutput:
    """Lines that a command printed to stdout and to stderr."""

    out: list[str]
    err: list[str]


def output_of(*arguments: object, status: int = 0) -> CommandOutput:
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        assert run(*arguments) == status, err.getvalue()
    return CommandOutput(out.getvalue().splitlines(), err.getvalue().splitlines())
