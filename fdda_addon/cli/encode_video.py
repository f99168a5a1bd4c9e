# SPDX-License-Identifier: GPL-3.0-or-later
"""`encode-video FOLDER OUT CONTAINER CODEC WIDTH HEIGHT FPS`: encodes the pictures of a film (`evaluation.video`)."""

import argparse
import os
import shutil
import sys
from pathlib import Path

import bpy

from ..core.errors import FDDAError, exit_status
from ..core.files.stop_signals import exit_on_stop_signal
from ..evaluation.video import write_video
from .progress import ProgressPrinter


def add_options(parser: argparse.ArgumentParser) -> None:
    for name, kind in (("folder", Path), ("out", Path), ("container", str), ("codec", str), ("width", int)):
        parser.add_argument(name, type=kind)
    parser.add_argument("height", type=int)
    parser.add_argument("fps", type=float)


def run(options: argparse.Namespace) -> None:
    # The process that started this one removes the file.
    exit_on_stop_signal()
    encoding, size, status = (options.container, options.codec), (options.width, options.height), 0
    with ProgressPrinter() as progress:
        try:
            pictures, out, fps = options.folder, options.out, options.fps
            write_video(pictures, out, encoding, size, fps, lambda *counts: progress.show("encoding", *counts))
        except FDDAError as error:
            print(f"Error: {error}", file=sys.stderr)
            status = exit_status(error)
    sys.stdout.flush()
    sys.stderr.flush()
    # Nothing is left to do but to remove Blender's own folder; Blender 4.5 as a module may hang at its end.
    shutil.rmtree(bpy.app.tempdir, ignore_errors=True)
    os._exit(status)
