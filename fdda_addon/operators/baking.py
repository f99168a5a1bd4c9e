# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that bakes: it writes what the bound model shows into a file that plays without the add-on."""

from collections.abc import Iterator
from pathlib import Path

import bpy

from ..core.errors import OutputError
from .job import JobOperator
from .playback import OnModel


class FDDA_OT_bake(OnModel, JobOperator, bpy.types.Operator):
    bl_idname = "fdda.bake"
    bl_label = "Bake…"
    bl_description = (
        "Write what the bound model shows, frame by frame, into a file that plays without the add-on: a .pc2 point "
        "cache, or a copy of this .blend file"
    )
    bl_options = {"REGISTER"}
    verb, title = "bake", "Bake"

    filepath: bpy.props.StringProperty(
        name="File", description="Where to write, a .pc2 or a .blend file", subtype="FILE_PATH"
    )
    filter_glob: bpy.props.StringProperty(default="*.pc2;*.blend", options={"HIDDEN"})
    check_existing: bpy.props.BoolProperty(default=True, options={"HIDDEN"})
    action: bpy.props.StringProperty(
        name="Action", description="Name of the action; empty for the frames of the scene as it is animated"
    )
    shape_keys: bpy.props.BoolProperty(
        name="Shape Keys",
        description="Keep the positions in the .blend file, a shape key each frame, and not in a .pc2 file beside it",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return cls.is_idle() and cls.has_bound(context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if self.filepath:
            return JobOperator.invoke(self, context, event)
        name = Path(bpy.data.filepath).stem or "character"
        self.filepath = bpy.path.abspath(f"//{name}_baked.blend")
        self._is_browsing = True
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        if getattr(self, "_is_browsing", False):
            # The file browser executes; the job is to run in ticks.
            return bpy.ops.fdda.bake(
                "INVOKE_DEFAULT", filepath=self.filepath, action=self.action, shape_keys=self.shape_keys
            )
        return JobOperator.execute(self, context)

    def draw(self, _context: bpy.types.Context) -> None:
        self.layout.prop_search(self, "action", bpy.data, "actions")
        self.layout.prop(self, "shape_keys")

    def steps(self, context: bpy.types.Context) -> Iterator[object]:
        from ..baking import BakeSettings, bake
        from ..runtime.model_files import network_of

        scene_rig = self.bound_rig(context)
        if not self.filepath:
            raise OutputError("No file was chosen; give the name of a .pc2 or .blend file.")
        settings = BakeSettings(self.action, shape_keys=self.shape_keys)
        out = Path(bpy.path.abspath(self.filepath))
        yield from bake(scene_rig, network_of(scene_rig.mesh_object), out, settings)

    def finish(self, _context: bpy.types.Context, result: object) -> str:
        names = " and ".join(path.name for path in result.files)
        return f"{len(result.frames)} frames are in {names}."


CLASSES = (FDDA_OT_bake,)
