# SPDX-License-Identifier: GPL-3.0-or-later
"""The option that lets a verb write over what `core.output.check_outputs` would refuse."""

import argparse


def add_overwrite(parser: argparse.ArgumentParser) -> None:
    """`--overwrite`."""
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="write over a file that is read, or over one of another kind; without it that is refused",
    )
