# SPDX-License-Identifier: GPL-3.0-or-later
"""The operator that renders the film of an action: rig, linear skinning, model and heat map side by side."""

from pathlib import Path

import bpy

from ..core.errors import RigError
from ..core.files.file_kind import VIDEO
from ..core.files.output import check_outputs
from ..core.progress import Job
from ..core.settings import FILM_TIMED_FRAMES
from ..core.wording import format_count
from ..evaluation.film import FDDA, LINEAR, RIG, Film, FilmSettings, film
from ..evaluation.picture import View
from ..evaluation.run import evaluate_action
from ..evaluation.video import check_video_path
from ..poses.action_range import action_frames
from ..poses.clip import find_action
from ..properties.view import active_action_name
from ..runtime.binding import model_disabled
from ..runtime.model_files import network_of
from ..scene.scene_rig import SceneRig
from ..scene.time_stretching import time_ratio
from ..timing.benchmark import benchmark
from .job import FileJobOperator
from .rig_operator import NEEDS_MODEL


class FDDA_OT_render_comparison(FileJobOperator, bpy.types.Operator):
    bl_idname = "fdda.render_comparison"
    bl_label = "Render Comparison"
    bl_description = (
        "Render a film of the action: rig, linear skinning, model and heat map side by side, as seen in the 3D View"
    )
    needs = NEEDS_MODEL
    verb, title = "render_comparison", "Film"

    filepath: bpy.props.StringProperty(
        name="File", description="Video to write, .mp4 or .webm", subtype="FILE_PATH", options={"SKIP_SAVE"}
    )
    filter_glob: bpy.props.StringProperty(default="*.mp4;*.webm", options={"HIDDEN"})
    action: bpy.props.StringProperty(
        name="Action",
        description="Action to show. Empty for the active action of the rig",
        options={"SKIP_SAVE"},
    )
    direction: bpy.props.FloatVectorProperty(
        name="Direction",
        description="Direction towards the viewer. Zero for a view from the front left",
        options={"HIDDEN", "SKIP_SAVE"},
    )

    def suggested_path(self, context: bpy.types.Context) -> str:
        scene_rig = self.bound_rig(context)
        self.action = self._action_name(scene_rig)
        if context.region_data is not None:
            self.direction = context.region_data.view_matrix.inverted().to_3x3().col[2]
        file = Path(bpy.data.filepath).stem or "character"
        return f"//{bpy.path.clean_name(f'{file}_{scene_rig.mesh_object.name}_{self.action}')}.mp4"

    def draw(self, _context: bpy.types.Context) -> None:
        self.layout.prop_search(self, "action", bpy.data, "actions")

    def steps(self, context: bpy.types.Context) -> Job[tuple[Path, Film]]:
        scene_rig, scene = self.bound_rig(context), context.scene
        path = Path(bpy.path.abspath(self.filepath))
        check_video_path(path)
        check_outputs([(path, VIDEO)], [Path(bpy.data.filepath)])
        name = self._action_name(scene_rig)
        network = network_of(scene_rig.mesh_object)
        with model_disabled(scene_rig.mesh_object):
            times = yield from benchmark(scene_rig.armature_object, FILM_TIMED_FRAMES)
            settings = FilmSettings(
                view=View.from_direction(self.direction) if any(self.direction) else View(),
                fps=scene.render.fps / scene.render.fps_base * time_ratio(),
                times_ms={variant: times.median(variant) for variant in (RIG, LINEAR, FDDA) if variant in times.times},
            )
            evaluation = yield from evaluate_action(scene_rig, network, name)
            first_frame = action_frames(find_action(name)).start
            result = yield from film(scene_rig, network, evaluation.held_out, first_frame, path, settings)
        return path, result

    def finish(self, _context: bpy.types.Context, result: tuple[Path, Film]) -> str:
        path, film = result
        return f"Rendered {format_count(film.frames, 'frame')} to {path.name}."

    def _action_name(self, scene_rig: SceneRig) -> str:
        name = self.action or active_action_name(scene_rig)
        if not name:
            raise RigError(f"'{scene_rig.armature_object.name}' has no action; give it one.")
        return name


CLASSES = (FDDA_OT_render_comparison,)
