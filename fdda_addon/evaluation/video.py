# SPDX-License-Identifier: GPL-3.0-or-later
"""Encodes pictures as a video, with the FFmpeg that is part of Blender, in another Blender that can be ended."""

from collections.abc import Callable
from pathlib import Path

import bpy

from ..core.errors import FDDAError, OutputError, WrongUsageError
from ..core.files.output import atomic_write
from ..core.progress import Job
from ..jobs.verb_process import VerbProcess
from ..scene.blend_file import blender_path, report_message
from ..scene.compatibility import set_video_format

ENCODINGS = {".mp4": ("MPEG4", "H264", "H.264"), ".webm": ("WEBM", "WEBM", "VP9")}
"""Blender's names of container and codec, and the name of the codec in messages, by the extension of the file."""
INDEXES = {".mp4": b"moov", ".webm": b"\x1c\x53\xbb\x6b"}
"""Identifier of the index of frames, by extension. FFmpeg writes the index last, so a file without it is incomplete."""


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


def encode(folder: Path, path: Path, size: tuple[int, int], fps: float) -> Job[None]:
    """Encode pictures as a video in another Blender; closing the generator ends it and leaves no file.

    Args:
        folder: folder of PNG files, one for each frame, in the order of their names.
        path: path of the video, with an extension of `ENCODINGS`.
        size: width and height, even numbers of pixels.
        fps: frames per second.

    Raises:
        OutputError: the video cannot be written, or this Blender lacks the encoder.
    """
    suffix, problem = path.suffix.lower(), ""
    container, codec, codec_name = ENCODINGS[suffix]
    with atomic_write(path) as temporary_path:
        arguments = (folder, temporary_path, container, codec, *size, fps)
        try:
            with VerbProcess("encode-video", [*map(str, arguments)]) as process:
                yield from process.steps()
        except FDDAError as error:
            problem = str(error).rstrip(".")
        if problem or INDEXES[suffix] not in temporary_path.read_bytes():
            other = next(other for other in ENCODINGS if other != suffix)
            raise OSError(
                f"{problem or 'Blender wrote no video'}; the disk may be full, or this Blender lacks the encoder of "
                f"{codec_name}: try a name that ends in {other}"
            )


def write_video(
    folder: Path,
    path: Path,
    encoding: tuple[str, str],
    size: tuple[int, int],
    fps: float,
    show: Callable[[int, int], None],
) -> None:
    """Encode pictures in this Blender; arguments as of `encode`.

    Args:
        encoding: Blender's names of container and codec.
        show: is called with the number of encoded frames, and of all.

    Raises:
        OutputError: the reason of Blender.
    """
    pictures = sorted(folder.glob("*.png"))
    scene = bpy.data.scenes.new("FDDA video")
    strip = scene.sequence_editor_create().strips.new_image("film", blender_path(pictures[0]), 1, 1)
    for picture in pictures[1:]:
        strip.elements.append(picture.name)
    scene.frame_start, scene.frame_end = 1, len(pictures)
    render = scene.render
    render.resolution_x, render.resolution_y = size
    render.fps = max(1, round(fps))
    render.fps_base = render.fps / fps
    scene.view_settings.view_transform = "Standard"
    set_video_format(render.image_settings)
    render.ffmpeg.format, render.ffmpeg.codec = encoding
    render.ffmpeg.audio_codec, render.ffmpeg.constant_rate_factor, render.ffmpeg.gopsize = "NONE", "HIGH", 12
    render.use_file_extension, render.filepath = False, blender_path(path)
    bpy.app.handlers.render_write.append(lambda shown, _: show(shown.frame_current, len(pictures)))
    try:
        bpy.ops.render.render(animation=True, scene=scene.name)
    except RuntimeError as error:
        raise OutputError(report_message(error)) from error
