# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that makes a fast rig of the saved file, in another Blender."""

import re
from pathlib import Path

import bpy

from ..core.errors import OutputError, RigError
from ..core.files.temporary import temporary_folder
from ..core.progress import Job
from ..jobs.verb_process import VerbProcess
from ..runtime.model_files import write_models
from ..scene.scene_rig import SceneRig, armature_of
from .job import FileJobOperator
from .rig_operator import NEEDS_MODEL


class FDDA_OT_fast_rig(FileJobOperator, bpy.types.Operator):
    bl_idname = "fdda.fast_rig"
    bl_label = "Fast Rig"
    bl_description = (
        "Write a file for animators with the same names, without the bones and objects that the model and the controls "
        "do not need. Relocate the library to this file for rendering"
    )
    needs = NEEDS_MODEL
    verb, title = "fast_rig", "Fast Rig"
    changes_scene = False

    filepath: bpy.props.StringProperty(
        name="File", description="File to write, .blend", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )
    filter_glob: bpy.props.StringProperty(default="*.blend", options={"HIDDEN"})
    visible: bpy.props.BoolProperty(name="Visible Bones", description="Keep the bones that are visible", default=True)
    keyed: bpy.props.BoolProperty(
        name="Keyed Bones", description="Keep the bones that an action of this file keys", default=True
    )
    collection: bpy.props.StringProperty(
        name="Bone Collection", description="Keep the bones of this bone collection", options={"SKIP_SAVE"}
    )

    def suggested_path(self, context: bpy.types.Context) -> str:
        self._check_saved(self.bound_rig(context))
        return f"//{Path(bpy.data.filepath).stem}_fast.blend"

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.label(text="Made from the saved file", icon="INFO")
        self.layout.label(text="Controls to Keep:")
        self.layout.prop(self, "visible")
        self.layout.prop(self, "keyed")
        self.layout.label(text="Bone Collection:")
        armature = self.bound_rig(context).armature_object.data
        self.layout.prop_search(self, "collection", armature, "collections_all", text="")

    def steps(self, context: bpy.types.Context) -> Job[str]:
        scene_rig = self.bound_rig(context)
        self._check_saved(scene_rig)
        choices = [*(["visible"] if self.visible else []), *(["keyed"] if self.keyed else [])]
        if self.collection:
            choices.append(f"collection:{self.collection}")
        if not choices:
            raise RigError("No controls were chosen; keep the visible or keyed bones, or those of a bone collection.")
        if not self.filepath:
            raise OutputError("No file was chosen; give the name of a .blend file.")
        out = bpy.path.ensure_ext(bpy.path.abspath(self.filepath), ".blend")
        mesh_objects = [
            o
            for o in context.scene.objects
            if o.type == "MESH" and o.fdda.is_bound and armature_of(o) == scene_rig.armature_object
        ]
        with temporary_folder() as folder:
            model = write_models(mesh_objects, folder)
            names = [f"--object={mesh_objects[0].name}"] if len(mesh_objects) == 1 else []
            arguments = [bpy.data.filepath, str(model), out, *names, "--controls", *choices]
            with VerbProcess("fast-rig", arguments) as process:
                return (yield from process.steps())

    def finish(self, _context: bpy.types.Context, result: str) -> str:
        lines = [line.strip() for line in result.splitlines()]
        # The first and the last line begin with the path of the file.
        start = re.match(r".*\.blend: ", lines[0], re.IGNORECASE)
        prefix = start[0] if start else ""
        summary, *texts = (line.removeprefix(prefix) for line in lines)
        sentences = [f"{Path(prefix).name}{summary}.", *(f"{text[:1].upper()}{text[1:]}." for text in texts)]
        return " ".join(sentences)

    def _check_saved(self, scene_rig: SceneRig) -> None:
        """Check that there is a saved file of a full rig.

        Unsaved changes are allowed, because Blender 4.5 counts what playback restores after a save as a change.
        """
        mesh_object = scene_rig.mesh_object
        if mesh_object.fdda.is_fast_rig:
            raise RigError(f"'{mesh_object.name}' is a fast rig already; open the file of the full rig.")
        if mesh_object.library is not None or mesh_object.override_library is not None:
            raise RigError(f"'{mesh_object.name}' comes from a library; open the file of the character.")
        if not bpy.data.filepath:
            raise RigError("Save the .blend file first: the fast rig is made from the saved file.")


CLASSES = (FDDA_OT_fast_rig,)
