# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of the section "Rig": add the sample arm, measure the speed of the rig."""

import bpy
from mathutils import Matrix

from ..arm.rig import build_arm
from ..core.progress import Job
from ..scene.viewport import frame_objects
from ..timing import measurements
from ..timing.benchmark import FDDA, RIG, Benchmark, benchmark
from .job import JobOperator


class FDDA_OT_add_sample_arm(bpy.types.Operator):
    bl_idname = "fdda.add_sample_arm"
    bl_label = "FDDA Sample Arm"
    bl_description = (
        "Add a rigged arm with 22 bones, a driven biceps, delta mush and an action, to train a first model on"
    )
    bl_options = {"REGISTER", "UNDO"}

    density: bpy.props.EnumProperty(
        name="Density",
        description="Number of vertices",
        items=(
            ("1", "1,476 Vertices", "Quick to record and train, but too cheap for a model to be faster"),
            ("2", "9,960 Vertices", "A model is about 7x faster than the rig, and takes some minutes to make"),
            ("3", "50,618 Vertices", "A model is about 23x faster than the rig, but recording takes a while"),
        ),
        default="2",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if context.mode != "OBJECT":
            cls.poll_message_set("Objects can only be added in Object Mode")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        scene = context.scene
        cube = context.scene.objects.get("Cube")
        hidden = (
            cube is not None
            and cube.type == "MESH"
            and len(cube.data.vertices) == 8
            and not cube.modifiers
            and cube.animation_data is None
            and cube.matrix_world == Matrix.Identity(4)
            and cube.visible_get()
        )
        if hidden:
            cube.hide_set(True)
            cube.hide_render = True
        frames = (scene.frame_start, scene.frame_end, scene.frame_current)
        has_animation = len(bpy.data.actions) > 0
        mesh_object, armature_object = build_arm(int(self.density))
        if has_animation:
            # Only a scene without actions gets the frame range of the arm's action.
            scene.frame_start, scene.frame_end = frames[:2]
            scene.frame_set(frames[2])
        for selected in context.selected_objects:
            selected.select_set(False)
        mesh_object.select_set(True)
        context.view_layer.objects.active = mesh_object
        frame_objects([mesh_object])
        count = len(mesh_object.data.vertices)
        remark = " The default cube is hidden." if hidden else ""
        self.report(
            {"INFO"}, f"Added '{mesh_object.name}' with {count:,} vertices on '{armature_object.name}'.{remark}"
        )
        return {"FINISHED"}


class FDDA_OT_measure(JobOperator, bpy.types.Operator):
    bl_idname = "fdda.measure"
    bl_label = "Measure Speed"
    bl_description = (
        "Measure the time per frame of all meshes of this armature, with the rig and with the bound models. "
        "Without a bound model, untrained models of the same size give an estimate"
    )
    verb, title = measurements.MEASURE, "Measuring"

    frames: bpy.props.IntProperty(
        name="Frames", description="Number of frames to measure", default=30, min=5, max=10000
    )

    def steps(self, context: bpy.types.Context) -> Job[Benchmark]:
        return (yield from benchmark(self.rig(context).armature_object, self.frames))

    def finish(self, context: bpy.types.Context, result: Benchmark) -> str:
        measurements.store(self.verb, self.rig(context).armature_object, result)
        return (
            f"'{result.armature}': {result.median(RIG):.2f} ms per frame with the rig, {result.median(FDDA):.2f} ms "
            f"with {result.describe_models()}. {result.sentence}"
        )


def _draw_add_menu(self: bpy.types.Menu, _context: bpy.types.Context) -> None:
    self.layout.operator("fdda.add_sample_arm", icon="OUTLINER_OB_ARMATURE")


CLASSES = (FDDA_OT_add_sample_arm, FDDA_OT_measure)
MENUS = {"VIEW3D_MT_armature_add": _draw_add_menu}


def unregister() -> None:
    """Drop all measurements."""
    measurements.clear()
