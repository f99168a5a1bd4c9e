# SPDX-License-Identifier: GPL-3.0-or-later
"""Train the arm from an Alembic file of its action: `python benchmarks/through_alembic.py OUT`.

Exports the deformed arm, removes all modifiers but the Armature, and trains from the Alembic file with
`examples/cache/learn_from_cache.py`. Compares the residuals with those of a recording of the rig itself, and prints the
held-out errors of both recordings with several seeds, for docs/simulations.md.
"""

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import bpy  # noqa: E402
import numpy as np  # noqa: E402
from simulation import time_verb  # noqa: E402

import fdda_addon  # noqa: E402
from blend_fixtures.flesh import keep_armature_modifier  # noqa: E402
from fdda_addon.arm.rig import build_arm  # noqa: E402
from fdda_addon.core.recording.reader import read_recording  # noqa: E402
from fdda_addon.scene.blend_file import save_copy  # noqa: E402

ACTION = "arm_drive"
SEEDS = (0, 1, 2)


def build(rig_path: Path, armature_only_path: Path, cache_path: Path) -> None:
    """Save the arm, an Alembic file of its action, and the arm with only its Armature modifier."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build_arm()
    save_copy(rig_path)
    scene = bpy.context.scene
    arm = next(o for o in scene.objects if o.type == "MESH")
    for scene_object in scene.objects:
        scene_object.select_set(scene_object == arm)
    first, last = (round(frame) for frame in bpy.data.actions[ACTION].frame_range)
    bpy.ops.wm.alembic_export(filepath=str(cache_path), selected=True, start=first, end=last, flatten=False)
    keep_armature_modifier(arm)
    save_copy(armature_only_path)


def held_out_mm(recording: Path, folder: Path) -> list[float]:
    """Train with each seed; return the mean errors of the held-out frames."""
    errors = []
    for seed in SEEDS:
        model = folder / str(seed) / "arm.onnx"
        model.parent.mkdir(parents=True, exist_ok=True)
        time_verb("train", recording, model, "--seed", seed)
        report = json.loads((model.parent / "report.json").read_text(encoding="utf-8"))
        errors.append(report["fdda"]["held_out"]["mean"])
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    fdda_addon.register()
    rig_path, armature_only_path, cache_path, rig_recording, output_folder = (
        out / name for name in ("rig.blend", "bare.blend", "arm.abc", "own", "learned")
    )
    build(rig_path, armature_only_path, cache_path)
    time_verb("record", rig_path, rig_recording, "--object", "arm", "--poses", 0, "--action", ACTION, "--resume")
    example = ROOT / "examples" / "cache" / "learn_from_cache.py"
    command = [
        sys.executable,
        str(example),
        str(armature_only_path),
        str(cache_path),
        str(output_folder),
        "--object",
        "arm",
        "--action",
        ACTION,
    ]
    subprocess.run(command, check=True, cwd=ROOT)
    recordings = [read_recording(path) for path in (rig_recording, output_folder / "recording")]
    difference = np.abs(recordings[0].residuals - recordings[1].residuals).max() / recordings[0].rig.size
    print(
        f"{recordings[0].residuals.shape[0]} frames; "
        f"largest difference of the residuals: {difference:.1e} of the character's size"
    )
    for name, recording in (("the rig itself", rig_recording), ("through Alembic", output_folder / "recording")):
        errors = held_out_mm(recording, out / f"{recording.parent.name}_{recording.name}")
        seed_errors = ", ".join(f"{error:.4f}" for error in errors)
        print(f"{name}: held-out mean {statistics.median(errors):.4f} mm, median of the seeds ({seed_errors})")


if __name__ == "__main__":
    main()
