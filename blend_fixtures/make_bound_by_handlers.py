# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the two bound files of an older version of the add-on, in which handlers played and cache objects were saved:

    python blend_fixtures/make_bound_by_handlers.py CODE MODEL

CODE is the repository as it was at commit 69f7151 (`git archive 69f7151 | tar -x -C CODE`), MODEL a model of the elbow.
bound_by_handlers.blend is a file as a user saved it, and caught_playing.blend one as Blender's own auto-save left it:
it holds the playing state, with the rig off and the shape keys pinned.
"""

import sys
from pathlib import Path

import bpy

HERE = Path(__file__).resolve().parent
CODE, MODEL = (Path(argument).resolve() for argument in sys.argv[1:3])
sys.path.insert(0, str(CODE))

from fdda_addon.elbow import build_elbow  # noqa: E402
from fdda_addon.scene.rig import find_rig  # noqa: E402

import fdda_addon  # noqa: E402
from fdda_addon.runtime.binding import bind  # noqa: E402

fdda_addon.register()
bpy.context.preferences.filepaths.save_version = 0
bpy.ops.wm.read_factory_settings(use_empty=True)
fdda_addon.register()
build_elbow()
rig = find_rig()
bind(rig, MODEL)
mesh_object = rig.mesh_object
mesh_object.fdda.mode = "RIG"
mesh_object.shape_key_add(name="Basis")
key = mesh_object.shape_key_add(name="bulge")
key.data[0].co.x += 0.05
key.value = 1.0
mesh_object.active_shape_key_index = 1
mesh_object.fdda.mode = "FDDA"
bpy.context.scene.frame_set(12)
# From here on nothing is evaluated: the model lies beside the file when it is opened.
mesh_object.fdda.model = "//elbow.onnx"
bpy.ops.wm.save_as_mainfile(
    filepath=str(HERE / "bound_by_handlers.blend"), compress=True, relative_remap=False, copy=True
)
for handlers in (bpy.app.handlers.save_pre, bpy.app.handlers.save_post):
    handlers.clear()
bpy.ops.wm.save_as_mainfile(filepath=str(HERE / "caught_playing.blend"), compress=True, relative_remap=False, copy=True)
fdda_addon.unregister()
