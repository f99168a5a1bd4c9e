# SPDX-License-Identifier: GPL-3.0-or-later
"""`poses RIG.blend OUT.blend`: saves a copy of a file with an action of recorded or random poses, one per frame."""

import argparse
from pathlib import Path

from ..core.errors import WrongUsageError
from ..core.files.file_kind import BLEND
from ..core.files.output import check_outputs
from ..core.recording.index import read_index, read_info
from ..core.wording import format_count
from ..recording.plan import RecordingSettings
from ..recording.posed_action import make_posed_action, recorded_settings
from ..runtime.binding import model_disabled
from ..scene.blend_file import save_copy
from ..scene.scene_rig import find_character
from .files import add_overwrite_option, add_rig_options, open_file
from .pose_options import add_pose_options, pose_settings
from .progress import ProgressPrinter


def add_options(parser: argparse.ArgumentParser) -> None:
    add_rig_options(parser)
    parser.add_argument("out", metavar="OUT.blend", type=Path, help="file to save, with the action")
    parser.add_argument("--recording", metavar="RECORDING", type=Path, help="use the poses of this recording")
    add_pose_options(parser)
    add_overwrite_option(parser)


def run(options: argparse.Namespace) -> None:
    info, index = None, {}
    settings = RecordingSettings(**pose_settings(options))
    if options.recording:
        if settings != RecordingSettings():
            raise WrongUsageError("--recording has its own poses; leave the other options of poses out.")
        index = read_index(options.recording)
        info = read_info(index)
        settings = recorded_settings(info)
    check_outputs({options.out: BLEND}, (options.rig,), options.overwrite)
    open_file(options.rig)
    names = [mesh["name"] for mesh in index.get("meshes", ())]
    scene_rig = find_character([options.object] if options.object and len(names) < 2 else names or [""])
    if info is None:
        settings = RecordingSettings(**pose_settings(options, scene_rig))
    with ProgressPrinter() as progress, model_disabled(*scene_rig.mesh_objects):
        action, driven = progress.run(make_posed_action(scene_rig, settings, info))
    save_copy(options.out)
    if driven:
        print(f"Keyed, with their drivers muted: {', '.join(driven)}.")
    count = int(action.frame_range[1])
    print(f"{options.out}: {format_count(count, 'pose')} in the action '{action.name}', after the rest pose in frame 0")
