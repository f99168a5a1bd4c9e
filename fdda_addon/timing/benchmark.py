# SPDX-License-Identifier: GPL-3.0-or-later
"""Times frames of a character, which is all meshes of one armature, with its rig and with models.

The variants are measured alternately, so that other work on the machine slows all of them and their ratios stay right.
Without a model, an untrained one measures how fast a trained model will be on this machine.
"""

import os
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import bpy
import numpy as np

from ..core.errors import FDDAError, RigError
from ..core.files.temporary import temporary_folder
from ..core.formats.untrained_model import build_untrained_model
from ..core.progress import Job, Progress
from ..core.wording import format_count
from ..poses.sampling import model_channels
from ..rig.dependencies import read_dependencies
from ..rig.modifier_stack import check_evaluable, deforming_modifiers
from ..rig.reading import read_rig
from ..rig.shape_keys import key_distances
from ..rig.time_inputs import check_time_inputs
from ..runtime import model_files
from ..runtime.binding import model_disabled, temporary_binding, temporary_mode
from ..runtime.opened_model import read_matching_rig
from ..scene.scene_rig import SceneRig, armature_modifier, check_full_rig, join_rigs, rigs_of_armature
from ..scene.temporary_state import deformation_disabled, temporary_attributes
from .animation import main_rig, temporary_animation
from .durations import WARM_UP_FRAMES, temporary_armature_scene, temporary_scene, time_calls, time_frames

ROUNDS, MAX_ROUNDS = 5, 15
"""Smallest and largest number of rounds. Each round measures all variants, one after the other."""

MAX_RATIO_SPREAD = 0.1
"""Spread of the ratio of two times (`_ratio_spread`) at which no further round is measured."""

MIN_WORTHWHILE_RATIO = 1.5
"""Smallest ratio of the frame times of rig and models at which models are worth it."""

MAX_RATIO_RANGE = 1.6
"""Largest ratio of the quartiles of the ratios of all rounds that allows a verdict."""

RIG, LINEAR, FDDA, WITHOUT_MESHES, BONES = "rig", "linear", "fdda", "without_meshes", "bones"

INFERENCE = "inference"

LABELS = {
    RIG: "rig",
    LINEAR: "Armature modifiers alone",
    FDDA: "FDDA",
    WITHOUT_MESHES: "without the meshes",
    BONES: "bones alone",
    INFERENCE: "the models alone, one pose",
}


@dataclass(frozen=True)
class MeshTimes:
    """A mesh of a character.

    Attributes:
        name: name of the mesh object.
        vertices: its number of vertices.
        has_model: whether a model of it was measured.
        reason: why no model can replace its rig; else empty.
    """

    name: str
    vertices: int
    has_model: bool = False
    reason: str = ""

    @property
    def variant(self) -> str:
        """Return the variant with the model of this mesh alone; a mesh may have the name of another variant."""
        return _only(self.name)


@dataclass(frozen=True)
class Benchmark:
    """Times of `scene.frame_set`, including everything that it evaluates, in milliseconds.

    Attributes:
        armature: name of the armature object.
        meshes: the meshes of the character, those with the most vertices first.
        model_count: number of meshes with a model.
        frames: number of timed frames of each variant.
        times: the times of each variant. `LINEAR` lacks for a character without Armature modifiers; meshes without one
            do not deform in it. `FDDA` has all models. `WITHOUT_MESHES` evaluates everything
            that models keep except the meshes of the character, `BONES` the armature alone. `INFERENCE` is one run of
            all models for one pose, outside of Blender's evaluation.
        rounds: the median time of each variant but `INFERENCE` in each round.
        is_estimate: whether the models are untrained.
    """

    armature: str
    meshes: tuple[MeshTimes, ...]
    model_count: int
    frames: int
    times: Mapping[str, list[float]]
    rounds: Mapping[str, list[float]]
    is_estimate: bool

    def median(self, variant: str) -> float:
        """Return the median time of a variant, ms; 0 if it was not measured.

        It is the median ratio to the rig in the same round, times the median of the rig, so that all times agree.
        """
        if variant not in self.rounds:
            return float(np.median(self.times.get(variant, [0.0])))
        return float(np.median(np.divide(self.rounds[variant], self.rounds[RIG])) * np.median(self.rounds[RIG]))

    @property
    def ratio(self) -> float:
        """Return how many times faster a frame is with the models than with the rig."""
        return self.median(RIG) / self.median(FDDA)

    @property
    def quartiles(self) -> tuple[float, float]:
        """Return the quartiles of the ratios of all rounds."""
        low, high = np.percentile(np.divide(self.rounds[RIG], self.rounds[FDDA]), (25, 75))
        return float(low), float(high)

    @property
    def is_worthwhile(self) -> bool:
        """Return whether the models are clearly faster than the rig."""
        return min(self.quartiles[0], self.ratio) >= MIN_WORTHWHILE_RATIO

    @property
    def sentence(self) -> str:
        """Return a verdict; if there is nothing to gain, with the reason."""
        low, high = self.quartiles
        note = " (estimate)" if self.is_estimate else ""
        if self.is_worthwhile:
            return f"{'Worth it: ' if self.is_estimate else ''}{self.ratio:.1f}x faster than the rig{note}."
        if high > MAX_RATIO_RANGE * low and high >= 1:
            return (
                f"The machine is busy: {low:.1f} to {high:.1f}x as fast as the rig in repeated measurements{note}. "
                "Measure again when it is idle."
            )
        if self.ratio > 1:
            return f"Little difference: {self.ratio:.1f}x faster than the rig{note}. {self._reason}"
        return f"Not worth it here: the rig is faster than {self.describe_models()}{note}. {self._reason}"

    def describe_models(self) -> str:
        """Return the words for the measured models."""
        count = self.model_count
        return "its model" if count == 1 else f"the models of {count} meshes"

    @property
    def _reason(self) -> str:
        """Return a sentence that says why there is little to gain."""
        rig, linear, others, bones = map(self.median, (RIG, LINEAR, WITHOUT_MESHES, BONES))
        if others >= rig / 2:
            subject, ms = ("The bones", bones) if bones >= others / 2 else ("Other objects", others - bones)
            return f"{subject} take {ms:.2f} of {rig:.2f} ms, which models do not change."
        if linear and rig - linear < rig / 4:
            return f"The rig takes only {max(rig - linear, 0):.2f} ms more than linear skinning alone."
        subject = "The meshes take" if len(self.meshes) > 1 else "The mesh takes"
        return (
            f"{subject} only {max(rig - others, 0):.2f} ms with the rig, and {self.median(FDDA) - others:.2f} ms "
            f"with {self.describe_models()}."
        )

    @property
    def shares(self) -> list[tuple[str, float, float]]:
        """Return the parts of a frame with their times with the rig and with the models, ms."""
        rig, fdda, others, bones = map(self.median, (RIG, FDDA, WITHOUT_MESHES, BONES))
        return [
            (
                "meshes" if len(self.meshes) > 1 else "mesh",
                max(rig - others, 0.0),
                max(fdda - others, 0.0),
            ),
            ("bones", bones, bones),
            ("other objects", max(others - bones, 0.0), max(others - bones, 0.0)),
        ]

    def to_json(self) -> dict:
        """Return the times as JSON, described in docs/formats.md."""
        return {
            "unit": "ms",
            "armature": self.armature,
            "vertices": sum(mesh.vertices for mesh in self.meshes),
            "meshes": [
                {"name": m.name, "vertices": m.vertices, "has_model": m.has_model, "reason": m.reason}
                for m in self.meshes
            ],
            "frames": self.frames,
            "blender": bpy.app.version_string,
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
            **{
                variant: {"median": _round(self.median(variant)), "p90": _round(np.percentile(times, 90))}
                for variant, times in self.times.items()
                if variant in LABELS
            },
            "model_alone": {m.name: _round(self.median(m.variant)) for m in self.meshes if m.variant in self.times},
            "ratio": _round(self.ratio),
            "ratio_quartiles": [_round(ratio) for ratio in self.quartiles],
            "is_faster": self.ratio > 1,
            "is_estimate": self.is_estimate,
        }

    def table(self) -> str:
        """Format the times as tables, followed by a verdict."""
        names = f"{format_count(len(self.meshes), 'mesh', 'meshes')} of {self.armature}, ms per frame"
        lines = [f"{names:<37}{'median':>10}{'p90':>10}"]
        for variant, times in ((variant, times) for variant, times in self.times.items() if variant in LABELS):
            lines.append(f"  {LABELS[variant]:<35}{self.median(variant):>10.3f}{np.percentile(times, 90):>10.3f}")
        lines.append(f"{'part of a frame, ms':<37}{'rig':>17}{'FDDA':>17}")
        rig, fdda = self.median(RIG), self.median(FDDA)
        for label, before, after in self.shares:
            lines.append(f"  {label:<35}{before:>10.3f} {before / rig:>5.0%}{after:>11.3f} {after / fdda:>5.0%}")
        lines += [f"  {line}" for line in self.mesh_lines()]
        return "\n".join([*lines, f"  {self.sentence}"])

    def mesh_lines(self) -> list[str]:
        """Return a line for each mesh of several."""
        lines = []
        for mesh in self.meshes if len(self.meshes) > 1 else ():
            text = mesh.reason or ("" if mesh.has_model else "no model")
            if mesh.variant in self.times:
                ms = self.median(mesh.variant)
                text = f"its model alone {ms:.2f} ms, {self.median(RIG) / ms:.1f}x as fast"
            lines.append(f"{mesh.name} ({mesh.vertices:,} vertices): {text or 'the only model'}")
        return lines


def _only(mesh_name: str) -> str:
    return f"only {mesh_name}"


def _round(value: float) -> float:
    return round(float(value), 4)


def benchmark(
    armature_object: bpy.types.Object, frames: int, models: Mapping[bpy.types.Object, Path] | None = None
) -> Job[Benchmark]:
    """Time the rig of a character and its models while the generator is iterated.

    It plays the action of the armature, or random poses if there is none, and restores the scene afterwards.

    Args:
        frames: number of frames to time for each variant.
        models: paths of models, by mesh object; further meshes play their bound models. If there is no model at all,
            untrained models are measured.

    Raises:
        FDDAError: as `check_full_rig`; or no mesh can be evaluated, or no model was trained for its rig. Meshes that
            fail beside others have a `reason`.
    """
    rigs = rigs_of_armature(armature_object)
    models = dict(models or {})
    for scene_rig in rigs:
        check_full_rig(scene_rig.mesh_object)
    with ExitStack() as stack:
        for scene_rig in rigs:
            stack.enter_context(model_disabled(scene_rig.mesh_object))
        candidates = [rig for rig in rigs if rig.mesh_object in models or rig.mesh_object.fdda.is_bound]
        is_estimate, reasons = not candidates, {}
        if is_estimate:
            models, reasons = stack.enter_context(untrained_models(rigs))
            candidates = [rig for rig in rigs if rig.mesh_object in models]
        played, networks = [], []
        error: FDDAError | None = None
        for scene_rig in candidates:
            mesh_object = scene_rig.mesh_object
            try:
                check_evaluable(scene_rig)
                if mesh_object in models:
                    stack.enter_context(temporary_binding(scene_rig, models[mesh_object]))
                networks.append(model_files.network_of(mesh_object))
            except FDDAError as mesh_error:
                error, reasons[mesh_object] = error or mesh_error, str(mesh_error)
            else:
                played.append(scene_rig)
        if not played:
            raise error or RigError(next(iter(reasons.values())))
        animated, channels = main_rig(played), ()
        if not is_estimate:
            network = networks[played.index(animated)]
            channels = model_channels(animated, read_matching_rig(animated, network.path, network.info), network.info)
        animation_frames = stack.enter_context(temporary_animation(animated, channels))
        mesh_objects = [rig.mesh_object for rig in rigs]
        others = [o for o in bpy.context.scene.objects if o not in mesh_objects and o.visible_get()]
        scenes = {
            WITHOUT_MESHES: stack.enter_context(temporary_scene(others)),
            BONES: stack.enter_context(temporary_armature_scene(armature_object)),
        }
        meshes = [rig.mesh_object for rig in played]
        show: dict[str, Callable[[], AbstractContextManager]] = {
            RIG: partial(_models_shown, ()),
            LINEAR: partial(_skinning_shown, [rig.mesh_object for rig in rigs]),
            FDDA: partial(_models_shown, meshes),
            WITHOUT_MESHES: partial(_models_shown, ()),
            BONES: partial(_models_shown, ()),
        }
        if all(armature_modifier(mesh_object) is None for mesh_object in meshes):
            del show[LINEAR]
        if len(rigs) > 1 and len(meshes) > 1:
            show |= {_only(mesh_object.name): partial(_models_shown, [mesh_object]) for mesh_object in meshes}
        times: dict[str, list[float]] = {variant: [] for variant in show}
        rounds: dict[str, list[float]] = {variant: [] for variant in show}
        frames_per_round = max(1, -(-frames // ROUNDS))
        index = 0
        while index < ROUNDS or (index < MAX_ROUNDS and _ratio_spread(rounds) > MAX_RATIO_SPREAD):
            for number, (variant, shown) in enumerate(show.items(), 1):
                with shown():
                    scene = scenes.get(variant, bpy.context.scene)
                    round_times = time_frames(scene, animation_frames, index * frames_per_round, frames_per_round)
                times[variant] += round_times
                rounds[variant].append(float(np.median(round_times)))
                # More rounds than the smallest number are rare, and a total that grows would look like a fault.
                yield Progress("benchmark", min(index * len(show) + number, ROUNDS * len(show) - 1), ROUNDS * len(show))
            index += 1
        # Meshes may share a model, which runs once.
        networks = list(dict.fromkeys(network.model for network in networks))
        times[INFERENCE] = list(np.sum([_inference_times(network, frames) for network in networks], axis=0))
    described = [MeshTimes(o.name, len(o.data.vertices), o in meshes, reasons.get(o, "")) for o in mesh_objects]
    return Benchmark(
        armature_object.name,
        tuple(sorted(described, key=lambda mesh: -mesh.vertices)),
        len(played),
        frames_per_round * index,
        times,
        rounds,
        is_estimate,
    )


def _inference_times(network: object, frames: int) -> list[float]:
    pose_matrices = network.info.rest_matrices[None]
    controls = np.zeros((1, len(network.info.controls)), np.float32)
    return time_calls([lambda: network.positions(pose_matrices, controls)] * (frames + WARM_UP_FRAMES))


def _ratio_spread(rounds: Mapping[str, list[float]]) -> float:
    """Return the distance of the quartiles of the ratios of rig and models in all rounds, relative to their median."""
    low, middle, high = np.percentile(np.divide(rounds[RIG], rounds[FDDA]), (25, 50, 75))
    return float((high - low) / middle)


@contextmanager
def _models_shown(mesh_objects: list[bpy.types.Object]) -> Iterator[None]:
    """Play the models of mesh objects in the block."""
    with ExitStack() as stack:
        for mesh_object in mesh_objects:
            stack.enter_context(temporary_mode(mesh_object, "FDDA"))
        yield


@contextmanager
def _skinning_shown(mesh_objects: list[bpy.types.Object]) -> Iterator[None]:
    """Show Blender's own linear skinning in the block: Armature modifiers alone, with the first shape key pinned."""
    with ExitStack() as stack:
        for mesh_object in mesh_objects:
            skin_modifier = armature_modifier(mesh_object)
            other_modifiers = [modifier for modifier in deforming_modifiers(mesh_object) if modifier != skin_modifier]
            if skin_modifier is not None:
                stack.enter_context(temporary_attributes(skin_modifier, use_deform_preserve_volume=False))
            stack.enter_context(deformation_disabled(mesh_object, other_modifiers))
        yield


@contextmanager
def untrained_models(
    rigs: Iterable[SceneRig],
) -> Iterator[tuple[dict[bpy.types.Object, Path], dict[bpy.types.Object, str]]]:
    """Write an untrained model of the meshes of an armature to a temporary folder; remove the folder afterwards.

    Yields:
        The path of the model, and why other meshes can have none, by mesh object.
    """
    rigs_of_model, reasons = [], {}
    for scene_rig in rigs:
        try:
            check_time_inputs(scene_rig, read_dependencies(scene_rig).controls, check_evaluable(scene_rig))
            read_rig(scene_rig)
        except FDDAError as error:
            reasons[scene_rig.mesh_object] = str(error)
        else:
            rigs_of_model.append(scene_rig)
    with temporary_folder() as folder:
        path = folder / "untrained.onnx"
        try:
            if rigs_of_model:
                character = join_rigs(rigs_of_model)
                dependencies = read_dependencies(character)
                rig = read_rig(character, dependencies.bones)
                distances = {}
                for mesh_object, vertices in zip(character.mesh_objects, rig.mesh_slices, strict=True):
                    for name, values in key_distances(character, mesh_object).items():
                        distances[name] = np.zeros(rig.vertex_count, np.float32)
                        distances[name][vertices] = values
                controls = (c for c in dependencies.controls if c.name not in distances or distances[c.name].any())
                path.write_bytes(build_untrained_model(replace(rig, controls=tuple(controls)), distances))
        except FDDAError as error:
            reasons |= {scene_rig.mesh_object: str(error) for scene_rig in rigs_of_model}
            rigs_of_model = []
        yield {scene_rig.mesh_object: path for scene_rig in rigs_of_model}, reasons
