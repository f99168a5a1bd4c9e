# SPDX-License-Identifier: GPL-3.0-or-later
"""The option `--overwrite` for outputs that `core.output.check_outputs` refuses."""

import argparse


def add_overwrite_option(parser: argparse.ArgumentParser) -> None:
    """Declare `--overwrite`."""
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="overwrite input files and files of another kind",
    )
