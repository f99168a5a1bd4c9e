# SPDX-License-Identifier: GPL-3.0-or-later
"""Rebuilds the fixtures of this folder: `python blend_fixtures/make_fixtures.py [FOLDER]`.

arm.blend holds the arm at density 1, elbow.blend the plain elbow. They are saved by the oldest LTS line of Blender that
the tests run on, so that every line opens them.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import bpy

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from blend_fixtures.elbow import build_elbow  # noqa: E402
from fdda_addon.arm.rig import build_arm  # noqa: E402

FIXTURES: dict[str, Callable[[], object]] = {"arm.blend": build_arm, "elbow.blend": build_elbow}
OLDEST_LINE = (4, 5)


def make_fixtures(folder: Path):
    """Writes every fixture into `folder`, over what is there."""
    # No arm.blend1 beside arm.blend.
    bpy.context.preferences.filepaths.save_version = 0
    for name, build in FIXTURES.items():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        build()
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / name), compress=True, check_existing=False)


if __name__ == "__main__":
    if bpy.app.version[:2] != OLDEST_LINE:
        line = ".".join(map(str, OLDEST_LINE))
        sys.exit(f"The fixtures are saved by Blender {line}, and this is {bpy.app.version_string}: use its Python.")
    make_fixtures(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
