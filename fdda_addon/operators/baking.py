# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators that write a character to files that play without the add-on: baked caches, and fitted skin weights."""

import os
import re
from pathlib import Path

import bpy

from ..baking.run import BakeSettings, bake_file
from ..core.errors import OutputError
from ..core.files.temporary import temporary_folder
from ..core.progress import Job
from ..core.recording.index import read_index
from ..jobs.verb_process import VerbProcess
from ..properties.character import recording_folder
from ..runtime.model_files import write_models
from ..scene.blend_file import save_copy
from .job import FileJobOperator
from .rig_operator import NEEDS_MODEL

FORMATS = {".blend": ".blend", ".abc": ".abc", ".usd": ".usdc", ".usda": ".usdc", ".usdc": ".usdc"}
"""Extensions of a bake, each with its value of `FDDA_OT_bake.format`."""


class FDDA_OT_bake(FileJobOperator, bpy.types.Operator):
    bl_idname = "fdda.bake"
    bl_label = "Bake"
    bl_description = (
        "Write the meshes as their models deform them to a file that plays without the add-on: Alembic, USD, or a copy "
        "of this .blend file"
    )
    needs = NEEDS_MODEL
    verb, title = "bake", "Bake"
    changes_scene = False
    _checked_format = ".blend"
    """The format when `check` was called last."""

    filepath: bpy.props.StringProperty(
        name="File",
        description="File to write, .abc, .usd, .usdc, .usda or .blend",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )
    filter_glob: bpy.props.StringProperty(default="*.abc;*.usd;*.usdc;*.usda;*.blend", options={"HIDDEN"})
    format: bpy.props.EnumProperty(
        name="Format",
        description="File to bake to. A script chooses it by the extension of the file",
        items=(
            (".blend", ".blend with Alembic", "A copy of this file, in which the meshes play an .abc file next to it"),
            (".abc", "Alembic", "An .abc file alone"),
            (".usdc", "USD", "A .usdc file"),
        ),
    )
    action: bpy.props.StringProperty(
        name="Action",
        description="Action to bake. Empty for the animation of the scene",
        options={"SKIP_SAVE"},
    )
    use_frames: bpy.props.BoolProperty(name="Frame Range", description="Bake these frames instead of all of the action")
    frame_start: bpy.props.IntProperty(name="Start", description="First frame", default=1)
    frame_end: bpy.props.IntProperty(name="End", description="Last frame", default=250)
    samples: bpy.props.IntProperty(
        name="Samples",
        description="Samples per frame, for motion blur of an Alembic file",
        default=1,
        min=1,
    )

    def suggested_path(self, context: bpy.types.Context) -> str:
        self._checked_format = self.format
        name = bpy.path.clean_name(self.bound_rig(context).mesh_object.name)
        return f"//{Path(bpy.data.filepath).stem or 'character'}_{name}_baked{self.format}"

    def check(self, _context: bpy.types.Context) -> bool:
        """Give the file in the browser the extension of a new format, and take the format of a typed extension."""
        before, path = (self.filepath, self.format, self.samples), self.filepath
        stem, suffix = os.path.splitext(path)
        typed_format = FORMATS.get(suffix.lower())
        if self.format == self._checked_format and typed_format:
            self.format = typed_format
        elif os.path.basename(path) and typed_format != self.format:
            self.filepath = (stem if typed_format else path) + self.format
        self._checked_format = self.format
        if self.format == ".usdc":
            self.samples = 1
        return (self.filepath, self.format, self.samples) != before

    def draw(self, _context: bpy.types.Context) -> None:
        column = self.layout.column()
        column.prop(self, "format")
        column.prop_search(self, "action", bpy.data, "actions")
        column.prop(self, "use_frames")
        row = column.row(align=True)
        row.active = self.use_frames
        row.prop(self, "frame_start")
        row.prop(self, "frame_end")
        samples = column.row()
        samples.enabled = self.format != ".usdc"
        samples.prop(self, "samples")

    def steps(self, context: bpy.types.Context) -> Job[str]:
        mesh_objects = [scene_rig.mesh_object for scene_rig in self.bound_rigs(context)]
        if not self.filepath:
            raise OutputError("No file was chosen; give the name of an .abc, .usd or .blend file.")
        frames = (self.frame_start, self.frame_end) if self.use_frames else None
        linear = tuple(mesh_object.name for mesh_object in mesh_objects if mesh_object.fdda.mode == "LINEAR")
        settings = BakeSettings(self.action, frames, self.samples, linear=linear)
        name = mesh_objects[0].name if len(mesh_objects) == 1 else ""
        with temporary_folder() as folder:
            file = folder / "rig.blend"
            save_copy(file)
            model = write_models(mesh_objects, folder)
            out = Path(bpy.path.abspath(self.filepath))
            return (yield from bake_file(file, model, out, settings, name))

    def finish(self, _context: bpy.types.Context, result: str) -> str:
        # The line begins with the path of the file.
        text = result.splitlines()[-1].removeprefix(bpy.path.abspath(self.filepath)).removeprefix(": ")
        return f"Baked {text} to {Path(self.filepath).name}."


class FDDA_OT_export_skinning(FileJobOperator, bpy.types.Operator):
    bl_idname = "fdda.export_skinning"
    bl_label = "Export Skinning"
    bl_description = (
        "Write a copy of this file whose recorded meshes follow bones by fitted skin weights alone, ready for glTF and "
        "FBX. Game engines play it without a model"
    )
    verb, title = "export_skinning", "Export Skinning"
    changes_scene = False

    filepath: bpy.props.StringProperty(
        name="File", description="File to write, .blend", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )
    filter_glob: bpy.props.StringProperty(default="*.blend", options={"HIDDEN"})
    influences: bpy.props.IntProperty(
        name="Bones per Vertex", description="Largest number of bones that move a vertex", default=4, min=1, max=16
    )

    def suggested_path(self, context: bpy.types.Context) -> str:
        read_index(recording_folder(self.rig(context).mesh_object))
        return f"//{Path(bpy.data.filepath).stem or 'character'}_skinned.blend"

    def draw(self, _context: bpy.types.Context) -> None:
        self.layout.prop(self, "influences")

    def steps(self, context: bpy.types.Context) -> Job[str]:
        mesh_object = self.rig(context).mesh_object
        recording = recording_folder(mesh_object)
        if not self.filepath:
            raise OutputError("No file was chosen; give the name of a .blend file.")
        out = bpy.path.ensure_ext(bpy.path.abspath(self.filepath), ".blend")
        with temporary_folder() as folder:
            file = folder / "rig.blend"
            save_copy(file)
            options = [f"--influences={self.influences}", f"--object={mesh_object.name}"]
            with VerbProcess("export-skinning", [str(file), str(recording), out, *options]) as process:
                return (yield from process.steps())

    def finish(self, _context: bpy.types.Context, result: str) -> str:
        print(result, end="")
        means = re.findall(r"^  held-out poses, (.+?) +([\d.]+) ", result, re.MULTILINE)
        text = ", ".join(f"{name} {value}" for name, value in means)
        return f"Wrote {Path(self.filepath).name}. Mean distance from the rig in held-out poses, mm: {text}."


CLASSES = (FDDA_OT_bake, FDDA_OT_export_skinning)
