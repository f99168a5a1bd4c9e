# SPDX-License-Identifier: GPL-3.0-or-later
"""`record RIG.blend RECORDING`: random poses and their residuals."""

import argparse
import time
from pathlib import Path


def add_options(parser: argparse.ArgumentParser) -> None:
    from .files import add_rig_options

    add_rig_options(parser)
    parser.add_argument("recording", metavar="RECORDING", type=Path, help="folder of the recording")
    parser.add_argument("--poses", type=int, default=1000, help="number of random poses (default 1000)")
    parser.add_argument("--seed", type=int, default=0, help="of the random poses (default 0)")
    parser.add_argument(
        "--spread", type=float, default=1.0, help="standard deviation as a part of half the range (default 1.0)"
    )
    parser.add_argument("--action", action="append", default=[], metavar="NAME", help="record its frames as well")
    parser.add_argument("--resume", action="store_true", help="continue a recording that was interrupted")


def run(options: argparse.Namespace) -> None:
    from ..core.errors import WrongUsageError
    from ..recording import RecordingSettings, record
    from ..runtime.binding import true_rig
    from .files import open_rig
    from .progress import ProgressPrinter

    if options.poses < 0 or options.seed < 0:
        raise WrongUsageError("--poses and --seed must be 0 or more.")
    # Wider is uniform already, and most draws would fall outside and be drawn again.
    if not 0 < options.spread <= 10:
        raise WrongUsageError("--spread must be more than 0 and at most 10.")
    scene_rig = open_rig(options)
    settings = RecordingSettings(
        poses=options.poses,
        seed=options.seed,
        spread=options.spread,
        actions=tuple(options.action),
        resume=options.resume,
    )
    start = time.monotonic()
    with ProgressPrinter() as progress, true_rig(scene_rig.mesh_object):
        for step in record(scene_rig, options.recording, settings):
            progress.show(step.stage, step.done, step.total)
    print(f"{options.recording}: {step.total} poses in {time.monotonic() - start:.1f} s")
