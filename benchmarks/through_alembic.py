# SPDX-License-Identifier: GPL-3.0-or-later
"""The arm learned through an Alembic file of its own action: `python benchmarks/through_alembic.py OUT`.

Exports what the arm shows, throws its stack away, and learns from the file with `examples/cache/learn_from_cache.py`.
Prints how far the residuals are from those of the rig itself, and the held-out errors of both with several seeds: the
figures of docs/simulations.md.
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
from simulation import verb  # noqa: E402

import fdda_addon  # noqa: E402
from blend_fixtures.flesh import keep_armature_modifier  # noqa: E402
from fdda_addon.arm.rig import build_arm  # noqa: E402
from fdda_addon.core.recording.reader import read_recording  # noqa: E402
from fdda_addon.scene.blend_file import save_copy  # noqa: E402

ACTION = "arm_drive"
SEEDS = (0, 1, 2)


def build(rig: Path, bare: Path, cache: Path) -> None:
    """The arm, an Alembic file of its action, and the arm without what computes that."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    build_arm()
    save_copy(rig)
    scene = bpy.context.scene
    arm = next(o for o in scene.objects if o.type == "MESH")
    for scene_object in scene.objects:
        scene_object.select_set(scene_object == arm)
    first, last = (round(frame) for frame in bpy.data.actions[ACTION].frame_range)
    bpy.ops.wm.alembic_export(filepath=str(cache), selected=True, start=first, end=last, flatten=False)
    keep_armature_modifier(arm)
    save_copy(bare)


def held_out_mm(recording: Path, folder: Path) -> list[float]:
    """Mean error of held-out frames after trainings with several seeds."""
    found = []
    for seed in SEEDS:
        model = folder / str(seed) / "arm.onnx"
        model.parent.mkdir(parents=True, exist_ok=True)
        verb("train", recording, model, "--seed", seed)
        report = json.loads((model.parent / "report.json").read_text(encoding="utf-8"))
        found.append(report["fdda"]["held_out"]["mean"])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    fdda_addon.register()
    rig, bare, cache, own, learned = (out / name for name in ("rig.blend", "bare.blend", "arm.abc", "own", "learned"))
    build(rig, bare, cache)
    verb("record", rig, own, "--object", "arm", "--poses", 0, "--action", ACTION, "--resume")
    example = ROOT / "examples" / "cache" / "learn_from_cache.py"
    command = [sys.executable, str(example), str(bare), str(cache), str(learned), "--object", "arm", "--action", ACTION]
    subprocess.run(command, check=True, cwd=ROOT)
    recordings = [read_recording(path) for path in (own, learned / "recording")]
    apart = np.abs(recordings[0].residuals - recordings[1].residuals).max() / recordings[0].rig.size
    print(f"{recordings[0].residuals.shape[0]} frames; largest difference of the residuals: {apart:.1e} of the size")
    for name, recording in (("the rig itself", own), ("through Alembic", learned / "recording")):
        errors = held_out_mm(recording, out / f"{recording.parent.name}_{recording.name}")
        seeds = ", ".join(f"{error:.4f}" for error in errors)
        print(f"{name}: held-out mean {statistics.median(errors):.4f} mm, median of the seeds ({seeds})")


if __name__ == "__main__":
    main()
