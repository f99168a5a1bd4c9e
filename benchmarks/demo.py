# SPDX-License-Identifier: GPL-3.0-or-later
"""`python benchmarks/demo.py FOLDER`: the arm from rig to playback, and how good it is, in one go."""

import math
import shutil
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from fdda_addon import register, unregister
from fdda_addon.arm.joints import ACTION, ELBOW_FLEXION, FINGERS
from fdda_addon.cli.evaluate import run_evaluation, table
from fdda_addon.cli.files import open_file
from fdda_addon.cli.main import main as run_verb
from fdda_addon.core.output import write_json
from fdda_addon.evaluation.picture import View
from fdda_addon.evaluation.pictures import draw_comparison, draw_partitions, make_pictured_pose
from fdda_addon.evaluation.run import Evaluation, EvaluationSettings, NamedPose
from fdda_addon.scene.scene_rig import find_rig
from fdda_addon.training.process import trainer_command

POSES, REFINED_POSES, HELD_OUT_POSES = 3000, 1000, 200
MARGIN = 2.0
EPOCHS = 50
"""As many steps as 200 epochs of a quarter of the poses: to record the arm costs little, to train it does."""
VIEW = View(azimuth=15, elevation=50)
FRAMES = {52: "reach", 110: "flex", 132: "fist", 190: "spread"}
METACARPAL_RANGE = 20.0


def _degrees(*angles: float) -> tuple[float, float, float]:
    return tuple(math.radians(angle) for angle in angles)


def _metacarpals(factor: float) -> dict[str, tuple[float, float, float]]:
    """All four at `factor` times their range, neighbors one against the other."""
    angle = factor * METACARPAL_RANGE
    return {f"{finger}_0": _degrees(angle * (-1) ** i, 0, angle * (-1) ** i) for i, finger in enumerate(FINGERS)}


EXTREME_POSES = (
    NamedPose("elbow 3x its range, off its axis", {"elbow": _degrees(70, 0, 3 * ELBOW_FLEXION)}),
    NamedPose("metacarpals 2.5x their range", _metacarpals(2.5)),
)


def main(folder: Path) -> int:
    """Run the demo; everything it makes lies in the folder, what it made before is replaced.

    Returns:
        The exit status.
    """
    rig, recording, model = folder / "arm.blend", folder / "recording", folder / "arm.onnx"
    evaluation_path, bound, pictures = folder / "evaluation.json", folder / "arm_bound.blend", folder / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(recording, ignore_errors=True)
    start = time.monotonic()
    refine = ["record", rig, recording, "--refine", model]
    for title, arguments in (
        ("1. The rig", ["build-arm", rig]),
        ("2. Poses and recording", ["record", rig, recording, "--poses", POSES, "--margin", MARGIN]),
        ("3. Training", ["train", recording, model, "--epochs", EPOCHS]),
        ("… and on, with more poses where the model is worst", [*refine, "--poses", REFINED_POSES]),
        ("", ["train", recording, model, "--epochs", EPOCHS, "--warm-start"]),
    ):
        if title:
            print(f"\n== {title}", flush=True)
        if status := run_verb([str(argument) for argument in arguments], "python -m fdda_addon"):
            return status

    print("\n== 4. Evaluation", flush=True)
    evaluation = _evaluate(rig, model, evaluation_path, pictures)
    # The report's page again, now with the held-out errors and the pictures.
    page = ["-P", "-m", "trainer.report", str(folder / "report.json")]
    command, environment = trainer_command([])
    subprocess.run(
        [command[0], *page, "--pictures", str(pictures), "--evaluation", str(evaluation_path)],
        env=environment,
        check=True,
    )

    print("\n== 5. Runtime", flush=True)
    if status := run_verb(["bind", str(rig), str(model), str(bound)], "python -m fdda_addon"):
        return status
    print(f"\n{table(evaluation)}\n\nDone in {time.monotonic() - start:.0f} s:")
    for path, what in (
        (rig, "the rig"),
        (recording, f"{POSES + REFINED_POSES} poses and their residuals"),
        (model, "the model"),
        (folder / "report.json", "the training in figures"),
        (folder / "report.html", "the training, the errors and the pictures as a page"),
        (evaluation_path, "the errors above, and those of each partition"),
        (bound, "the model in place of the rig: open it and play"),
        (pictures, "partitions, comparisons and heat maps"),
    ):
        print(f"  {path}{'/' if path.is_dir() else ''}  {what}")
    return 0


def _evaluate(rig: Path, model: Path, out: Path, pictures: Path) -> Evaluation:
    open_file(rig)
    scene_rig = find_rig()
    settings = EvaluationSettings(HELD_OUT_POSES, actions=(ACTION,), range_scales=(1.5, 2.0, 3.0), named=EXTREME_POSES)
    evaluation = run_evaluation(scene_rig, model, settings)
    write_json(out, evaluation.to_json())

    pictures.mkdir(exist_ok=True)
    drive = evaluation.actions[0]
    action_poses = [make_pictured_pose(drive, frame - 1, f"{name}, frame {frame}") for frame, name in FRAMES.items()]
    beyond = [make_pictured_pose(errors, 0, errors.name) for errors in evaluation.named]
    draw_partitions(scene_rig, pictures / "1_partitions.png", VIEW)
    for heat, prefix, kind in ((False, 2, "comparison"), (True, 3, "heat_map")):
        draw_comparison(scene_rig, model, action_poses, pictures / f"{prefix}_{kind}.png", heat, view=VIEW)
    for heat, prefix, kind in ((False, 4, "beyond"), (True, 5, "beyond_heat_map")):
        title = "Beyond the range of motion" + (": distance from the true rig" if heat else "")
        draw_comparison(scene_rig, model, beyond, pictures / f"{prefix}_{kind}.png", heat, title, VIEW)
    return evaluation


if __name__ == "__main__":
    register()
    try:
        status = main(Path(sys.argv[1]))
    finally:
        unregister()
    sys.exit(status)
