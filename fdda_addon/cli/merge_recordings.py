# SPDX-License-Identifier: GPL-3.0-or-later
"""`merge-recordings SHARD… RECORDING`: merges the shards of `record --shard`, without Blender."""

import argparse
import time
from pathlib import Path

from ..core.counts import format_count


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "shards", metavar="SHARD", type=Path, nargs="+", help="folders that record --shard has written, in any order"
    )
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="folder to write the merged recording to")


def run(options: argparse.Namespace) -> None:
    from ..core.recording.merge import merge_recordings
    from .progress import ProgressPrinter

    start = time.monotonic()
    with ProgressPrinter() as progress:
        for step in merge_recordings(options.shards, options.recording):
            progress.show(step.stage, step.done, step.total)
    seconds = time.monotonic() - start
    counts = f"{format_count(step.total, 'pose')} of {format_count(len(options.shards), 'shard')}"
    print(f"{options.recording}: {counts} in {seconds:.1f} s")
