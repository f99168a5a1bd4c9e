# SPDX-License-Identifier: GPL-3.0-or-later
"""Operators of the section "Compare with Rig": evaluate the model, color the mesh, show the rig, open the report."""

import math
from dataclasses import replace

import bpy

from ..core.checks.target import frozen_sentence
from ..core.errors import ModelError, RigError
from ..core.formats.report import REPORT_HTML, page_path
from ..core.progress import Job
from ..core.settings import EVALUATION_SEED, SIDEBAR_EVALUATION_POSES
from ..evaluation import heat_map, last_evaluation, side_by_side
from ..evaluation.results import Evaluation
from ..evaluation.run import evaluate_meshes, set_held_out_pose
from ..evaluation.settings import EvaluationSettings
from ..models import model_list
from ..models.model_list import bound_entry, bound_model_name
from ..poses.action_range import action_frames
from ..properties.recording_options import target_settings
from ..properties.view import active_action_name, show_graph
from ..runtime.binding import model_disabled
from ..runtime.model_files import network_of
from ..scene.scene_rig import SceneRig, check_full_rig
from ..scene.viewport import center_views, redraw_views
from .job import JobOperator
from .rig_operator import NEEDS_MODEL, RigOperator


class FDDA_OT_evaluate(JobOperator, bpy.types.Operator):
    bl_idname = "fdda.evaluate"
    bl_label = "Evaluate"
    bl_description = "Compare the bound model with the rig, on the action of the armature or on random poses"
    needs = NEEDS_MODEL
    verb, title = "evaluate", "Evaluation"

    source: bpy.props.EnumProperty(
        name="Compare On",
        description="Poses to compare the model with the rig on",
        items=(
            ("ACTION", "Action", "All frames of an action"),
            ("RANDOM", "Random Poses", "New random poses within the limits, which are in no recording"),
        ),
    )
    action: bpy.props.StringProperty(
        name="Action",
        description="Action to compare on. Empty for the active action of the armature",
        options={"SKIP_SAVE"},
    )
    poses: bpy.props.IntProperty(
        name="Poses", description="Number of random poses", default=SIDEBAR_EVALUATION_POSES, min=1
    )
    seed: bpy.props.IntProperty(name="Seed", description="Random seed of the poses", default=EVALUATION_SEED, min=0)

    def steps(self, context: bpy.types.Context) -> Job[list[tuple[int, Evaluation]]]:
        rigs = self.bound_rigs(context)
        self._action = (self.action or active_action_name(rigs[0])) if self.source == "ACTION" else ""
        if self.source == "ACTION" and not self._action:
            raise RigError(
                f"'{rigs[0].armature_object.name}' has no active action; choose one under Compare On, or compare on "
                "random poses."
            )
        # Meshes of one model are compared in one pass; one that learned from another object is compared alone.
        passes: dict[tuple, list[SceneRig]] = {}
        for rig in rigs:
            learn_from = rig.mesh_object.fdda.settings.learn_from
            passes.setdefault((network_of(rig.mesh_object).model, learn_from and rig.mesh_object), []).append(rig)
        evaluations: list[tuple[int, Evaluation]] = []
        with model_disabled(*(rig.mesh_object for rig in rigs)):
            for (network, _), group in passes.items():
                target = target_settings(group[0].mesh_object.fdda.settings)
                if self._action:
                    target = replace(target, settle_frames=0)
                    settings = EvaluationSettings(poses=0, actions=(self._action,), surface=False, target=target)
                else:
                    target = replace(target, pre_roll=0)
                    settings = EvaluationSettings(self.poses, self.seed, surface=False, target=target)
                uids = [rig.mesh_object.session_uid for rig in group]
                evaluations += zip(uids, (yield from evaluate_meshes(group, network, settings)), strict=True)
        return evaluations

    def finish(self, context: bpy.types.Context, result: list[tuple[int, Evaluation]]) -> str:
        first_frame = action_frames(bpy.data.actions[self._action]).start if self._action else 0
        sentences = []
        for uid, evaluation in result:
            mesh_object = next(o for o in bpy.data.objects if o.session_uid == uid)
            stored = last_evaluation.store(
                mesh_object, evaluation, bound_model_name(mesh_object), self._action, first_frame, self.seed
            )
            model_errors, skinning_errors = stored.total["fdda"], stored.total["linear"]
            of_mesh = f" of '{mesh_object.name}'" if len(result) > 1 else ""
            target = mesh_object.fdda.settings.learn_from
            reference = f"'{target}'" if target else "the rig"
            sentences.append(
                f"The model{of_mesh} is {model_errors.mean:.2f} mm from {reference} on average "
                f"and {model_errors.max:.1f} mm at most; "
                f"skinning alone {skinning_errors.mean:.2f} and {skinning_errors.max:.1f} mm."
            )
            sentences += filter(None, [frozen_sentence(evaluation.held_out.frozen)])
        context.window_manager.fdda_view.pose = -1
        if self._action:
            show_graph(context.window_manager.fdda_view.graph)
        redraw_views()
        return " ".join(sentences)


class EvaluationOperator(RigOperator):
    """Mixin for an operator on the last evaluation of a mesh."""

    needs = (last_evaluation.get, "Nothing has been compared in this session; press Evaluate first")

    def last_evaluation(self, context: bpy.types.Context) -> tuple[object, object]:
        """Return the rig and its last evaluation.

        Raises:
            FDDAError: there is no rig, or no evaluation.
        """
        scene_rig = self.rig(context)
        last = last_evaluation.get(scene_rig.mesh_object)
        if last is None:
            raise ModelError(
                f"'{scene_rig.mesh_object.name}' has not been compared in this session; press Evaluate first."
            )
        return scene_rig, last


class FDDA_OT_color_mesh(EvaluationOperator, bpy.types.Operator):
    bl_idname = "fdda.color_mesh"
    bl_label = "Color the Mesh"
    bl_description = "Show errors or body parts as colors in the viewport"
    bl_options = {"REGISTER"}
    needs = None

    colors: bpy.props.EnumProperty(
        name="Colors",
        description="Meaning of the colors",
        items=(
            ("NONE", "None", "Show the mesh without colors"),
            ("ERRORS", "Heat Map", "Show the errors of the last comparison"),
            ("PARTITIONS", "Body Parts", "Show one color for each body part"),
        ),
        default="ERRORS",
    )

    def apply(self, context: bpy.types.Context) -> str:
        if self.colors == "ERRORS":
            scene_rig, _ = self.last_evaluation(context)
            heat_map.paint_errors(scene_rig.mesh_object)
            view = context.window_manager.fdda_view
            if not view.is_property_set("range_mm"):
                view.range_mm = heat_map.suggested_range_mm(scene_rig.mesh_object) or view.range_mm
        elif self.colors == "PARTITIONS":
            scene_rig = self.rig(context)
            heat_map.paint_partitions(scene_rig, scene_rig.mesh_object.fdda.settings.min_vertices_per_part)
        else:
            scene_rig = self.rig(context)
            heat_map.clear(scene_rig.mesh_object)
        return ""


class FDDA_OT_fit_color_range(EvaluationOperator, bpy.types.Operator):
    bl_idname = "fdda.fit_color_range"
    bl_label = "Fit Range"
    bl_description = "Fit the range of the heat map to the errors that are shown"
    bl_options = {"REGISTER"}

    def apply(self, context: bpy.types.Context) -> str:
        scene_rig, _ = self.last_evaluation(context)
        range_mm = heat_map.suggested_range_mm(scene_rig.mesh_object)
        if not range_mm:
            raise ModelError("No errors are shown to fit the range to; choose another frame, or show the mean.")
        view = context.window_manager.fdda_view
        view.range_mm = range_mm
        return f"Max color: {view.range_mm:.3g} mm."


class FDDA_OT_jump_to_worst(EvaluationOperator, bpy.types.Operator):
    bl_idname = "fdda.jump_to_worst"
    bl_label = "Jump to Worst"
    bl_description = "Go to the frame, or show the random pose, with the largest error"

    rank: bpy.props.IntProperty(name="Rank", description="1 is the worst, 2 the next", default=1, min=1, max=50)

    zoom: bpy.props.BoolProperty(
        name="Zoom to Vertex", description="Look at the vertex with the largest error", options={"SKIP_SAVE"}
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.OperatorProperties) -> str:
        if properties.zoom:
            return "Go to this frame or random pose, and look at the vertex with the largest error"
        return cls.bl_description

    def apply(self, context: bpy.types.Context) -> str:
        scene_rig, last = self.last_evaluation(context)
        poses = last.worst_poses(self.rank)
        if not poses:
            raise ModelError("The model is exact in all compared poses; there is no worst one.")
        pose, error_mm = poses[-1]
        message = self._show_pose(context, scene_rig, last, pose)
        if self.zoom:
            index = int(last.errors["fdda"][pose].argmax())
            evaluated_object = scene_rig.mesh_object.evaluated_get(bpy.context.evaluated_depsgraph_get())
            # Modifiers that add vertices, such as a subdivision, keep the first ones.
            position = evaluated_object.matrix_world @ evaluated_object.data.vertices[index].co
            center_views(position, max(max(evaluated_object.dimensions) / 20, 1e-4))
        return f"{message}: max error {error_mm:.2f} mm."

    def _show_pose(
        self, context: bpy.types.Context, scene_rig: SceneRig, last: last_evaluation.LastEvaluation, pose: int
    ) -> str:
        """Show a pose of an evaluation, given its index, and return its name."""
        if last.name:
            frame = last.scene_frame(pose)
            context.scene.frame_set(math.floor(frame), subframe=frame - math.floor(frame))
            return f"Frame {round(frame)}"
        set_held_out_pose(scene_rig, last.channels, last.seed, pose)
        context.view_layer.update()
        context.window_manager.fdda_view.pose = pose
        return f"Random pose {pose + 1}"


class FDDA_OT_open_report(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.open_report"
    bl_label = "Open Training Report"
    bl_description = f"Open {REPORT_HTML}, which the training wrote next to the model, in the web browser"
    bl_options = {"REGISTER"}
    needs = NEEDS_MODEL

    def apply(self, context: bpy.types.Context) -> str:
        mesh_object = self.bound_rig(context).mesh_object
        entry = bound_entry(mesh_object)
        if entry is None:
            model_list.add_bound_model(mesh_object)
            entry = bound_entry(mesh_object)
        path = page_path(model_list.entry_path(mesh_object, entry).resolve())
        if not path.is_file():
            raise ModelError(f"There is no report '{path}'; move it next to the model, or train again.")
        try:
            bpy.ops.wm.url_open(url=path.as_uri())
        except RuntimeError as error:
            raise ModelError(f"No web browser could be started; open '{path}' yourself.") from error
        return f"Opened {path} in the web browser."


class FDDA_OT_show_rig(RigOperator, bpy.types.Operator):
    bl_idname = "fdda.show_rig"
    bl_label = "Show the Rig"
    bl_description = "Show the rig together with the model, next to it or over it as a wireframe"
    needs = NEEDS_MODEL

    placement: bpy.props.EnumProperty(
        name="Show the Rig",
        description="Where to show the rig",
        items=(
            ("NONE", "Off", "Show the model only"),
            ("BESIDE", "Beside", "Show the rig next to the model, on the right in front view"),
            ("OVERLAY", "Overlay", "Show the rig as a wireframe over the model"),
        ),
        default="BESIDE",
    )
    distance: bpy.props.FloatProperty(
        name="Distance",
        description="Distance along X. 0 for a little more than the width of the character",
        subtype="DISTANCE",
        options={"SKIP_SAVE"},
    )

    def apply(self, context: bpy.types.Context) -> str:
        rigs = self.bound_rigs(context)
        for scene_rig in rigs:
            if scene_rig.mesh_object.mode == "EDIT":
                raise RigError(f"'{scene_rig.mesh_object.name}' is in edit mode; leave it first.")
        for scene_rig in rigs if self.placement != "NONE" else ():
            check_full_rig(scene_rig.mesh_object)
        for scene_rig in rigs:
            side_by_side.show(scene_rig.mesh_object, self.placement, self.distance)
        names = " and ".join(f"'{rig.mesh_object.name}'" for rig in rigs)
        results = {"NONE": "is shown alone", "BESIDE": "has its rig beside it", "OVERLAY": "has its rig over it"}
        return f"{names} {results[self.placement]}."


CLASSES = (
    FDDA_OT_evaluate,
    FDDA_OT_show_rig,
    FDDA_OT_color_mesh,
    FDDA_OT_fit_color_range,
    FDDA_OT_jump_to_worst,
    FDDA_OT_open_report,
)


def unregister() -> None:
    """Remove all evaluations, colors, copies of rigs and graphs."""
    # Blender has no data while it starts or quits.
    if hasattr(bpy.data, "objects"):
        side_by_side.hide_all()
    show_graph(False)
    last_evaluation.clear()
    heat_map.clear_all()
