# SPDX-License-Identifier: GPL-3.0-or-later
"""Adds the option `--overwrite`, for outputs that `core.files.output.check_outputs` refuses to overwrite."""

import argparse


def add_overwrite_option(parser: argparse.ArgumentParser) -> None:
    """Add the option --overwrite."""
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="allow overwriting of input files and of files of another kind",
    )
