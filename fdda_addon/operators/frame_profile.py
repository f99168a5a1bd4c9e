# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator of the section "Rig" that profiles a frame."""

import json
from dataclasses import replace

import bpy

from ..core.errors import FDDAError
from ..core.files.temporary import temporary_folder
from ..core.progress import Job
from ..jobs.verb_process import VerbProcess
from ..scene.blend_file import save_copy
from ..timing import measurements
from ..timing.frame_profile import FastRigSaving, FrameProfile, profile_frame
from .job import JobOperator

STEPS = (
    ("timing objects", ("objects",)),
    *([] if bpy.app.background else [("timing drawing", ("drawing",))]),
    ("timing models", ("benchmark",)),
    ("timing a fast rig", ("frames",)),
)
"""Labels of the steps of a profile, and the stages of their progress."""


class FDDA_OT_profile_frame(JobOperator, bpy.types.Operator):
    bl_idname = "fdda.profile_frame"
    bl_label = "Profile Frame"
    bl_description = (
        "Measure how much time bones, each modifier, the rest of the evaluation and drawing take in a frame; and "
        "what models of all meshes and a fast rig would save"
    )
    verb, title = measurements.PROFILE, "Profiling"

    def steps(self, context: bpy.types.Context) -> Job[FrameProfile]:
        scene_rig = self.rig(context)
        self.state.steps = STEPS
        profile = yield from profile_frame(scene_rig.armature_object)
        return (yield from _with_fast_rig(profile, scene_rig.mesh_object.name))

    def finish(self, context: bpy.types.Context, result: FrameProfile) -> str:
        measurements.store(self.verb, self.rig(context).armature_object, result)
        largest_part = max(result.parts, key=lambda part: part.duration.median)
        share = largest_part.duration.median / max(result.total, 1e-9)
        return f"A frame takes {result.total:.2f} ms; {largest_part.title} takes {share:.0%}."


def _with_fast_rig(profile: FrameProfile, object_name: str) -> Job[FrameProfile]:
    """Measure what a fast rig would save, in another Blender with a copy of the open file; add it to a profile."""
    try:
        with temporary_folder() as folder:
            file, result_file = folder / "rig.blend", folder / "saving.json"
            save_copy(file)
            arguments = [str(file), "--fast-rig", f"--object={object_name}", "--json", str(result_file)]
            with VerbProcess("benchmark", arguments) as process:
                yield from process.steps()
            values = json.loads(result_file.read_text(encoding="utf-8"))
        values.pop("unit")
        return replace(profile, fast_rig=FastRigSaving(**values))
    except FDDAError as error:
        return replace(profile, fast_rig_problem=str(error))


CLASSES = (FDDA_OT_profile_frame,)
