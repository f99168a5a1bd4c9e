# SPDX-License-Identifier: GPL-3.0-or-later
"""`build-arm OUT.blend`: the example rig."""

import argparse
from pathlib import Path


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", metavar="OUT.blend", type=Path, help="where to save the rig")
    parser.add_argument(
        "--density", type=int, choices=(1, 2, 3), default=1, help="about 1,450, 10,000 or 50,000 vertices (default 1)"
    )


def run(options: argparse.Namespace) -> None:
    import bpy

    from ..arm import build_arm
    from ..core.output import check_writable
    from .files import save_copy

    check_writable(options.out)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    mesh_object, _ = build_arm(options.density)
    save_copy(options.out)
    print(f"{options.out}: an arm of {len(mesh_object.data.vertices)} vertices")
