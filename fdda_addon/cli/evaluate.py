# SPDX-License-Identifier: GPL-3.0-or-later
"""`evaluate RIG.blend MODEL.onnx --json OUT.json`: measures the distance between the model and its rig."""

import argparse
from contextlib import ExitStack
from pathlib import Path

import bpy

from ..core.checks.target import frozen_sentence
from ..core.errors import WrongUsageError
from ..core.files.file_kind import EVALUATION, PICTURE, VIDEO
from ..core.files.output import atomic_write_all, check_outputs, to_json_text
from ..core.sentences.assessment import farther_than_skinning_sentence
from ..core.settings import EVALUATION_POSES, EVALUATION_SEED, FILM_TIMED_FRAMES
from ..core.wording import format_count
from ..evaluation.film import FDDA, LABELS, LINEAR, RIG, FilmSettings, film
from ..evaluation.pictures import draw_comparison, representative_poses
from ..evaluation.results import Evaluation
from ..evaluation.run import evaluate_meshes
from ..evaluation.settings import EvaluationSettings
from ..evaluation.video import check_video_path
from ..poses.clip import find_clips
from ..runtime.binding import model_disabled
from ..scene.scene_rig import SceneRig
from ..scene.time_stretching import time_ratio
from ..timing.benchmark import benchmark
from .files import (
    add_model_argument,
    add_overwrite_option,
    add_repeatable_option,
    add_rig_options,
    open_rigs,
    to_json_by_object,
    with_heading,
)
from .pose_options import add_target_options, target_settings
from .progress import ProgressPrinter


def add_options(parser: argparse.ArgumentParser) -> None:
    add_rig_options(parser)
    add_model_argument(parser)
    parser.add_argument("--json", metavar="OUT.json", type=Path, required=True, help="file to write the errors to")
    parser.add_argument(
        "--poses",
        type=int,
        default=EVALUATION_POSES,
        help=f"number of new random poses (default {EVALUATION_POSES}); 0 to compare actions and strips only",
    )
    parser.add_argument(
        "--seed", type=int, default=EVALUATION_SEED, help=f"random seed of these poses (default {EVALUATION_SEED})"
    )
    add_repeatable_option(parser, "--action", "NAME", "also compare all frames of this action")
    add_repeatable_option(parser, "--strip", "NAME", "also compare all frames of this NLA strip")
    text = "also compare random poses within X times the rotation limits"
    add_repeatable_option(parser, "--range-scale", "X", text, type=float)
    add_target_options(parser)
    parser.add_argument(
        "--heatmap",
        metavar="OUT.png",
        type=Path,
        help="picture to write, with rig, linear skinning and model as heat maps of the first mesh",
    )
    parser.add_argument(
        "--video",
        metavar="OUT.mp4",
        type=Path,
        help="film of the first --action or --strip to write (.mp4 or .webm): rig, linear skinning, model and heat map",
    )
    add_overwrite_option(parser)


def run(options: argparse.Namespace) -> None:
    if options.poses < 0 or options.seed < 0 or min(options.range_scale, default=1) <= 0:
        raise WrongUsageError("--poses and --seed must be 0 or more, and --range-scale more than 0.")
    if not options.poses and (options.range_scale or not (options.action or options.strip)):
        raise WrongUsageError(
            "With --poses 0 only actions and strips are compared; give --action and no --range-scale."
        )
    if options.video and not (options.action or options.strip):
        raise WrongUsageError("--video shows the frames of an action; give --action or --strip.")
    target = target_settings(options)
    outputs = [(options.json, EVALUATION), *([(options.heatmap, PICTURE)] if options.heatmap else [])]
    if options.video:
        check_video_path(options.video)
        check_outputs([*outputs, (options.video, VIDEO)], (options.rig, options.model), options.overwrite)
    check_outputs(outputs, (options.rig, options.model), options.overwrite)
    rigs = open_rigs(options)
    if options.video and len(rigs) > 1:
        raise WrongUsageError(f"--video draws one mesh, and '{options.model}' deforms several; give --object.")
    settings = EvaluationSettings(
        options.poses,
        options.seed,
        tuple(options.action),
        tuple(options.range_scale),
        strips=tuple(options.strip),
        target=target,
    )
    if options.learn_from and len(rigs) > 1:
        raise WrongUsageError("--learn-from is of one mesh; give --object.")
    evaluations = run_evaluations(rigs, settings)
    with atomic_write_all(*(path for path, _ in outputs)) as (errors, *pictures):
        for picture in pictures:
            name, (scene_rig, model) = next(iter(rigs.items()))
            reference_name = f"target '{options.learn_from}'" if options.learn_from else "true rig"
            poses = representative_poses(evaluations[name].held_out)
            draw_comparison(scene_rig, model, poses, picture, is_heat_map=True, reference_label=reference_name)
        content = to_json_by_object({name: evaluation.to_json() for name, evaluation in evaluations.items()})
        errors.write_text(to_json_text(content), encoding="utf-8")
    if options.video:
        ((name, (scene_rig, model)),) = rigs.items()
        write_video(scene_rig, model, evaluations[name], options)
    for name, evaluation in evaluations.items():
        print(with_heading(name, table(evaluation)))


def write_video(scene_rig: SceneRig, model: Path, evaluation: Evaluation, options: argparse.Namespace) -> None:
    """Time the rig and the model, write the film of the first action, and print the progress to stderr."""
    clip = find_clips([scene_rig], options.action, options.strip)[0]
    with ProgressPrinter() as progress:
        models = {scene_rig.mesh_object: model}
        times = progress.run(benchmark(scene_rig.armature_object, FILM_TIMED_FRAMES, models))
        settings = FilmSettings(
            fps=bpy.context.scene.render.fps / bpy.context.scene.render.fps_base * time_ratio(),
            times_ms={variant: times.median(variant) for variant in (RIG, LINEAR, FDDA) if variant in times.times},
            reference_label=f"Target {options.learn_from}" if options.learn_from else LABELS[RIG],
        )
        with model_disabled(scene_rig.mesh_object):
            progress.run(film(scene_rig, model, evaluation.actions[0], clip.frames.start, options.video, settings))


def run_evaluations(rigs: dict[str, tuple[SceneRig, Path]], settings: EvaluationSettings) -> dict[str, Evaluation]:
    """Evaluate the models of rigs by their names, those of one model together; print the progress to stderr."""
    evaluations = {}
    with ProgressPrinter() as progress, ExitStack() as stack:
        for scene_rig, _ in rigs.values():
            stack.enter_context(model_disabled(scene_rig.mesh_object))
        for model in dict.fromkeys(model for _, model in rigs.values()):
            names = [name for name in rigs if rigs[name][1] == model]
            results = progress.run(evaluate_meshes([rigs[name][0] for name in names], model, settings))
            evaluations |= dict(zip(names, results, strict=True))
    return {name: evaluations[name] for name in rigs}


def table(evaluation: Evaluation) -> str:
    """Return the errors as a text table, mm."""
    heading = f"{'error in mm':<24}{'mean':>10}{'rms':>10}{'p99':>10}{'p99.9':>10}{'max':>10}"
    lines = [heading, "-" * len(heading)]
    random_errors = [] if any(errors is evaluation.held_out for errors in evaluation.actions) else [evaluation.held_out]
    for errors in (*random_errors, *evaluation.scaled_ranges, *evaluation.actions):
        values = errors.to_json()
        lines.append(f"{errors.name}, {format_count(values['poses'], 'pose')}")
        for key, label in (("linear", "  linear skinning"), ("fdda", "  FDDA")):
            row = values[key]
            cells = "".join(f"{row[name]:>10.4f}" for name in ("mean", "rms", "p99", "p999", "max"))
            lines.append(f"{label:<24}{cells}")
        ratios = "".join(
            f"{100 * values['fdda'][name] / max(values['linear'][name], 1e-12):>9.1f}%"
            for name in ("mean", "rms", "p99", "p999", "max")
        )
        lines.append(f"{'  FDDA / linear skinning':<24}{ratios}")
        farther_sentence = farther_than_skinning_sentence(values["fdda"]["mean"], values["linear"]["mean"])
        lines += [f"  {text}" for text in (farther_sentence, frozen_sentence(errors.frozen)) if text]
        if values["normals"]:
            lines += _surface_lines(values["normals"], values["edges"])
    return "\n".join(lines)


def _surface_lines(normals: dict, edges: dict) -> list[str]:
    """Return a line with the errors of normals, and a line with the errors of edge lengths."""
    angles, lengths = [], []
    for method, label in (("fdda", "FDDA"), ("linear", "linear skinning")):
        angle, edge = normals[method], edges[method]
        angles.append(f"{label} {angle['mean']:.3f}, p99 {angle['p99']:.2f}")
        parts = [
            "-" if edge[location] is None else f"{100 * edge[location]:.3f}"
            for location in ("inside", "beside", "across")
        ]
        ratio = "" if edge["ratio"] is None else f" ({edge['ratio']:.2f} times)"
        lengths.append(f"{label} {' / '.join(parts)}{ratio}")
    return [
        f"  normals, degrees: {'; '.join(angles)}",
        f"  edges, % of their length, inside / beside / across borders: {'; '.join(lengths)}",
    ]
