# SPDX-License-Identifier: GPL-3.0-or-later
"""Encodes pictures as a video, with the FFmpeg that is part of Blender."""

from pathlib import Path

import bpy

from ..core.errors import OutputError, WrongUsageError
from ..core.output import atomic_write
from ..scene.blend_file import blender_path, report_message, silenced_stdout
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


def encode(pictures: list[Path], path: Path, size: tuple[int, int], fps: float) -> None:
    """Encode pictures as a video.

    Args:
        pictures: PNG files in one folder, one for each frame.
        path: path of the video, with an extension of `ENCODINGS`.
        size: width and height, even numbers of pixels.
        fps: frames per second.

    Raises:
        OutputError: the video cannot be written, or this Blender lacks the encoder.
    """
    scene = bpy.data.scenes.new("FDDA video")
    try:
        strip = scene.sequence_editor_create().strips.new_image("film", blender_path(pictures[0]), 1, 1)
        for picture in pictures[1:]:
            strip.elements.append(picture.name)
        scene.frame_start, scene.frame_end = 1, len(pictures)
        render = scene.render
        render.resolution_x, render.resolution_y = size
        render.fps = max(1, round(fps))
        render.fps_base = render.fps / fps
        scene.view_settings.view_transform = "Standard"
        container, codec, _ = ENCODINGS[path.suffix.lower()]
        set_video_format(render.image_settings)
        render.ffmpeg.format, render.ffmpeg.codec, render.ffmpeg.audio_codec = container, codec, "NONE"
        render.ffmpeg.constant_rate_factor, render.ffmpeg.gopsize = "HIGH", 12
        render.use_file_extension = False
        with atomic_write(path) as temporary_path:
            _render(scene, temporary_path, path.suffix.lower())
    finally:
        bpy.data.scenes.remove(scene)


def _render(scene: bpy.types.Scene, path: Path, suffix: str) -> None:
    scene.render.filepath = blender_path(path)
    problem = ""
    try:
        with silenced_stdout():
            bpy.ops.render.render(animation=True, scene=scene.name)
    except RuntimeError as error:
        problem = report_message(error)
    if problem or INDEXES[suffix] not in path.read_bytes():
        codec = ENCODINGS[suffix][2]
        other = next(other for other in ENCODINGS if other != suffix)
        raise OSError(
            f"{problem or 'Blender wrote no video'}; the disk may be full, or this Blender lacks the encoder of "
            f"{codec}: try a name that ends in {other}"
        )
