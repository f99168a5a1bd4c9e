# SPDX-License-Identifier: GPL-3.0-or-later
"""Encodes pictures as a video in a Blender of its own, which `video` starts. The job comes as JSON from stdin."""

import json
import os
import sys

import bpy

from ..scene.blend_file import report_message
from ..scene.compatibility import set_video_format


def main() -> None:
    """Encode, printing `encoded N` after each frame, or `encoding failed: ` and the reason."""
    job = json.load(sys.stdin)
    scene, pictures = bpy.data.scenes.new("FDDA video"), job["pictures"]
    strip = scene.sequence_editor_create().strips.new_image("film", pictures[0], 1, 1)
    for picture in pictures[1:]:
        strip.elements.append(os.path.basename(picture))
    scene.frame_start, scene.frame_end = 1, len(pictures)
    render = scene.render
    render.resolution_x, render.resolution_y = job["size"]
    render.fps = max(1, round(job["fps"]))
    render.fps_base = render.fps / job["fps"]
    scene.view_settings.view_transform = "Standard"
    set_video_format(render.image_settings)
    encoding = render.ffmpeg
    encoding.format, encoding.codec, encoding.audio_codec = job["container"], job["codec"], "NONE"
    encoding.constant_rate_factor, encoding.gopsize = "HIGH", 12
    render.use_file_extension, render.filepath = False, job["path"]
    bpy.app.handlers.render_write.append(lambda shown, _: print(f"\nencoded {shown.frame_current}", flush=True))
    try:
        bpy.ops.render.render(animation=True, scene=scene.name)
    except RuntimeError as error:
        # Blender itself prints lines that begin with "Error: " when it ends, also after a success.
        print(f"\nencoding failed: {report_message(error)}", flush=True)
    sys.stdout.flush()
    # Nothing is left to do, and Blender 4.5 as a module may hang at its end.
    os._exit(0)
