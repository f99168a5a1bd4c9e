# SPDX-License-Identifier: GPL-3.0-or-later
"""Encodes pictures as a video, with the FFmpeg that is part of Blender, in another Blender that can be ended."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import bpy

from ..core.errors import OutputError, WrongUsageError
from ..core.files.child_process import OutputLines, child_options, end_process
from ..core.files.output import atomic_write
from ..scene.blend_file import blender_path

ENCODINGS = {".mp4": ("MPEG4", "H264", "H.264"), ".webm": ("WEBM", "WEBM", "VP9")}
"""Blender's names of container and codec, and the name of the codec in messages, by the extension of the file."""
INDEXES = {".mp4": b"moov", ".webm": b"\x1c\x53\xbb\x6b"}
"""Identifier of the index of frames, by extension. FFmpeg writes the index last, so a file without it is incomplete."""
WAIT_SECONDS = 0.05
"""Longest time between two steps while the other Blender encodes."""
_ENCODED_LINE = re.compile(r"encoded (?P<count>\d+)")
_FAILURE_LINE = re.compile(r"encoding failed: (?P<text>.+)")


def check_video_path(path: Path) -> None:
    """Check that the extension of a path is that of a video, and that this Blender can write videos.

    Raises:
        WrongUsageError: it has another extension.
        OutputError: this Blender was built without FFmpeg.
    """
    if path.suffix.lower() not in ENCODINGS:
        raise WrongUsageError(f"'{path}' ends in neither .mp4 nor .webm; give it the extension of what to write.")
    if not bpy.app.ffmpeg.supported:
        raise OutputError("This Blender was built without FFmpeg and writes no videos; use Blender from blender.org.")


def encode(pictures: list[Path], path: Path, size: tuple[int, int], fps: float) -> Iterator[int]:
    """Encode pictures as a video, as a generator; closing it ends the other Blender and leaves no file.

    Args:
        pictures: PNG files in one folder, one for each frame.
        path: path of the video, with an extension of `ENCODINGS`.
        size: width and height, even numbers of pixels.
        fps: frames per second.

    Yields:
        The number of encoded frames, also while it does not change.

    Raises:
        OutputError: the video cannot be written, or this Blender lacks the encoder.
    """
    suffix = path.suffix.lower()
    container, codec, codec_name = ENCODINGS[suffix]
    with atomic_write(path) as temporary_path:
        job = {
            "pictures": [blender_path(picture) for picture in pictures],
            "path": blender_path(temporary_path),
            "size": size,
            "fps": fps,
            "container": container,
            "codec": codec,
        }
        count, problem = 0, ""
        with _other_blender(json.dumps(job)) as (process, lines):
            while (line := lines.next(WAIT_SECONDS)) is not None:
                if match := _ENCODED_LINE.match(line):
                    count = int(match["count"])
                elif match := _FAILURE_LINE.match(line):
                    problem = match["text"].rstrip(".")
                yield count
            if (status := process.wait()) and not problem:
                problem = f"the other Blender ended with status {status}"
        if problem or INDEXES[suffix] not in temporary_path.read_bytes():
            other = next(other for other in ENCODINGS if other != suffix)
            raise OSError(
                f"{problem or 'Blender wrote no video'}; the disk may be full, or this Blender lacks the encoder of "
                f"{codec_name}: try a name that ends in {other}"
            )


@contextmanager
def _other_blender(job: str) -> Iterator[tuple[subprocess.Popen, OutputLines]]:
    """Start a Blender that encodes, and end it afterwards; yield its process, and the lines that it prints."""
    package = Path(__file__).resolve().parents[1]
    script = (
        f"import importlib, sys; sys.path.insert(0, {str(package.parent)!r}); "
        f"importlib.import_module('{package.name}.evaluation.video_encoder').main()"
    )
    if bpy.app.binary_path:
        command = [bpy.app.binary_path, "--background", "--factory-startup", "--python-exit-code", "1"]
        command += ["--python-expr", script]
    else:
        # The bpy module in a Python has no program.
        command = [sys.executable, "-c", script]
    options = child_options() | {"stdin": subprocess.PIPE}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **options)
    lines = OutputLines(_communicate(process, job))
    try:
        yield process, lines
    finally:
        end_process(process)
        lines.join()
        process.stdout.close()


def _communicate(process: subprocess.Popen, job: str) -> Iterator[str]:
    # A Blender that has ended already says why in its output.
    with suppress(OSError), process.stdin:
        process.stdin.write(job)
    yield from process.stdout
