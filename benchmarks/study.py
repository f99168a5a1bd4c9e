# SPDX-License-Identifier: GPL-3.0-or-later
"""Compare units, layers and activations of networks on the arm: `python benchmarks/study.py OUT [--seeds 3]`.

The reference work compares the same networks. Records the arm, trains each configuration with the verb `train`, and
prints the errors on held-out poses, which neither train nor choose. Models that are in OUT are not trained again.
"""

import argparse
import itertools
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.measure import inference  # noqa: E402

CONFIGURATIONS = [((64, 64), "silu"), *itertools.product(
    ((128, 128), (128, 128, 128), (512, 512), (512, 512, 512)), ("silu", "tanh", "relu")
)]  # fmt: skip
"""Units of the hidden layers, and activation; the first one is the trainer's default."""
DETAIL_MM = 0.02
"""The default would leave so many components out that networks could not differ."""


def run(*command: object) -> None:
    """Run a Python module on one core; end this program with its last line if it fails."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    process = subprocess.run(
        [sys.executable, "-m", *map(str, command)], stderr=subprocess.PIPE, text=True, env=environment
    )
    if process.returncode:
        sys.exit((process.stderr.strip().splitlines() or [f"{command[0]} failed without a message."])[-1])


def main() -> None:
    """Train all configurations, and print the table."""
    parser = argparse.ArgumentParser("study", description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder for all output")
    parser.add_argument("--seeds", type=int, default=3, help="trainings of each configuration (default 3)")
    parser.add_argument("--poses", type=int, default=1000, help="poses to record (default 1000)")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rig, recording = options.out / "arm.blend", options.out / "recording"
    if not recording.exists():
        run("fdda_addon", "build-arm", rig)
        run("fdda_addon", "record", rig, recording, "--poses", options.poses)
    models = {}
    for (units, activation), seed in itertools.product(CONFIGURATIONS, range(options.seeds)):
        model = options.out / f"{'x'.join(map(str, units))}-{activation}-{seed}" / "arm.onnx"
        models.setdefault((units, activation), []).append(model)
        if not model.exists():
            model.parent.mkdir(exist_ok=True)
            print(f"{model.parent.name} …", file=sys.stderr, flush=True)
            settings = ("--hidden", *units, "--activation", activation, "--seed", seed, "--detail-mm", DETAIL_MM)
            run("trainer", recording, model, *settings)
    print("| hidden layers | activation | mean, mm | 99.9 % | largest | training, s | one pose, ms | MB |")
    print("|---|---|---|---|---|---|---|---|")
    for (units, activation), paths in models.items():
        reports = [json.loads((path.parent / "report.json").read_text(encoding="utf-8")) for path in paths]
        errors = [[report["fdda"]["held_out"][name] for report in reports] for name in ("mean", "p999", "max")]
        seconds, size = (statistics.median(values) for values in zip(
            *((report["training"]["seconds"], report["model_bytes"] / 1e6) for report in reports), strict=True
        ))  # fmt: skip
        mean, p999, largest = map(statistics.median, errors)
        print(
            f"| {' '.join(map(str, units))} | {activation} | {mean:.4f} ({min(errors[0]):.4f} to {max(errors[0]):.4f}) "
            f"| {p999:.2f} | {largest:.2f} | {seconds:.0f} | {inference(str(paths[0]))['ms_at_1']:.2f} | {size:.2f} |"
        )


if __name__ == "__main__":
    main()
