# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that bakes the deformed mesh to a file, which plays without the add-on."""

from pathlib import Path

import bpy

from ..baking.run import Bake, BakeSettings, bake
from ..core.errors import OutputError
from ..core.progress import Job
from ..core.sentences.counts import format_count
from ..runtime.model_files import network_of
from .job import FileJobOperator
from .rig_operator import NEEDS_MODEL


class FDDA_OT_bake(FileJobOperator, bpy.types.Operator):
    bl_idname = "fdda.bake"
    bl_label = "Bake"
    bl_description = (
        "Write the mesh as the model deforms it to a file that plays without the add-on: a .pc2 point cache, or a copy "
        "of this .blend file"
    )
    bl_options = {"REGISTER"}
    needs = NEEDS_MODEL
    verb, title = "bake", "Bake"

    filepath: bpy.props.StringProperty(
        name="File", description="File to write, .pc2 or .blend", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )
    filter_glob: bpy.props.StringProperty(default="*.pc2;*.blend", options={"HIDDEN"})
    action: bpy.props.StringProperty(
        name="Action",
        description="Action to bake. Empty for the animation of the scene",
        options={"SKIP_SAVE"},
    )
    shape_keys: bpy.props.BoolProperty(
        name="Shape Keys",
        description="Write one shape key per frame to the .blend file, instead of a .pc2 file next to it",
        options={"SKIP_SAVE"},
    )
    point_cache: bpy.props.BoolProperty(
        name="Point Cache",
        description="Suggest a .pc2 file instead of a .blend file",
        options={"SKIP_SAVE", "HIDDEN"},
    )
    use_frames: bpy.props.BoolProperty(
        name="Frame Range", description="Bake these frames instead of all of the action", options={"SKIP_SAVE"}
    )
    frame_start: bpy.props.IntProperty(name="Start", description="First frame", default=1, options={"SKIP_SAVE"})
    frame_end: bpy.props.IntProperty(name="End", description="Last frame", default=250, options={"SKIP_SAVE"})

    def suggested_path(self, context: bpy.types.Context) -> str:
        name = bpy.path.clean_name(self.bound_rig(context).mesh_object.name)
        file = Path(bpy.data.filepath).stem or "character"
        return f"//{file}_{name}_baked{'.pc2' if self.point_cache else '.blend'}"

    def draw(self, _context: bpy.types.Context) -> None:
        # The sidebar has the fields; the file browser would list them again.
        pass

    def steps(self, context: bpy.types.Context) -> Job[Bake]:
        scene_rig = self.bound_rig(context)
        if not self.filepath:
            raise OutputError("No file was chosen; give the name of a .pc2 or .blend file.")
        strength = 0.0 if scene_rig.mesh_object.fdda.mode == "LINEAR" else None
        frames = (self.frame_start, self.frame_end) if self.use_frames else None
        settings = BakeSettings(self.action, frames, self.shape_keys, strength=strength)
        out = Path(bpy.path.abspath(self.filepath))
        return (yield from bake(scene_rig, network_of(scene_rig.mesh_object), out, settings))

    def finish(self, _context: bpy.types.Context, result: Bake) -> str:
        names = " and ".join(path.name for path in result.files)
        return f"Baked {format_count(len(result.frames), 'frame')} to {names}."


CLASSES = (FDDA_OT_bake,)
