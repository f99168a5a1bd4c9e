# SPDX-License-Identifier: GPL-3.0-or-later
"""Encodes pictures as a video, with the FFmpeg that is part of Blender, in another Blender that can be ended."""

import json
import os
import queue
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import bpy

from ..core.errors import OutputError, WrongUsageError
from ..core.output import atomic_write
from ..scene.blend_file import blender_path
from ..training.environment.subprocesses import UTF8_OUTPUT, popen_options

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
            while (line := _next_line(lines)) is not None:
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
def _other_blender(job: str) -> Iterator[tuple[subprocess.Popen, "queue.SimpleQueue[str | None]"]]:
    """Start a Blender that encodes, and end it afterwards.

    Yields:
        Its process, and the lines that it prints, None after the last one.
    """
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
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=os.environ | UTF8_OUTPUT,
        text=True,
        encoding="utf-8",
        errors="replace",
        **popen_options(),
    )
    lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    # In a thread, because writing a long job and reading a line block, and the window must not.
    thread = threading.Thread(target=_communicate, args=(process, job, lines), daemon=True)
    thread.start()
    try:
        yield process, lines
    finally:
        process.kill()
        process.wait()
        thread.join()
        process.stdout.close()


def _communicate(process: subprocess.Popen, job: str, lines: "queue.SimpleQueue[str | None]") -> None:
    # A Blender that has ended already says why in its output.
    with suppress(OSError), process.stdin:
        process.stdin.write(job)
    for line in process.stdout:
        lines.put(line)
    lines.put(None)


def _next_line(lines: "queue.SimpleQueue[str | None]") -> str | None:
    """Return the next line, empty if there is none yet, None at the end."""
    try:
        return lines.get(timeout=WAIT_SECONDS)
    except queue.Empty:
        return ""
