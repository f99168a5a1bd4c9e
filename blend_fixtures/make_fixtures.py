# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the .blend files of this folder again: `python blend_fixtures/make_fixtures.py [FOLDER]`.

arm.blend contains the arm at density 1, elbow.blend the plain elbow. The oldest Blender LTS line that runs the tests
saves them, so that every line can open them.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import bpy

FIXTURES_FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FIXTURES_FOLDER.parent))

from blend_fixtures.elbow import build_elbow  # noqa: E402
from fdda_addon.arm.rig import build_arm  # noqa: E402

BUILDERS: dict[str, Callable[[], object]] = {"arm.blend": build_arm, "elbow.blend": build_elbow}
OLDEST_BLENDER_VERSION = (4, 5)


def make_fixtures(folder: Path):
    """Write every fixture to a folder; existing files are replaced."""
    # Blender must not keep the previous file as arm.blend1.
    bpy.context.preferences.filepaths.save_version = 0
    for name, build in BUILDERS.items():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        build()
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / name), compress=True, check_existing=False)


if __name__ == "__main__":
    if bpy.app.version[:2] != OLDEST_BLENDER_VERSION:
        version = ".".join(map(str, OLDEST_BLENDER_VERSION))
        sys.exit(f"This is Blender {bpy.app.version_string}; run this script with the Python of Blender {version}.")
    make_fixtures(Path(sys.argv[1]) if len(sys.argv) > 1 else FIXTURES_FOLDER)
