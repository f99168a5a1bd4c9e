# SPDX-License-Identifier: GPL-3.0-or-later
"""`build-arm OUT.blend`: builds the example rig, an arm."""

import argparse
from pathlib import Path

import bpy

from ..arm.rig import build_arm
from ..core.files.file_kind import BLEND
from ..core.files.output import check_outputs
from ..scene.blend_file import save_copy
from ..scene.viewport import frame_objects
from .files import add_overwrite_option


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", metavar="OUT.blend", type=Path, help="file to save the rig to")
    parser.add_argument(
        "--density", type=int, choices=(1, 2, 3), default=1, help="about 1,450, 10,000 or 50,000 vertices (default 1)"
    )
    add_overwrite_option(parser)


def run(options: argparse.Namespace) -> None:
    check_outputs({options.out: BLEND}, overwrite=options.overwrite)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    mesh_object, _ = build_arm(options.density)
    frame_objects([mesh_object])
    save_copy(options.out)
    print(f"{options.out}: an arm of {len(mesh_object.data.vertices)} vertices")
