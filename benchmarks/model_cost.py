# SPDX-License-Identifier: GPL-3.0-or-later
"""Measure the cost of models without Blender: `python benchmarks/model_cost.py MODEL.onnx … [--json OUT.json]`.

Prints for each model the number of nodes, the bytes of constants that each frame reads, and the milliseconds per
character of a call with one pose and of a call with twenty. Hot calls run in a loop. Before each cold call, other
memory is read, as Blender does in a frame. The times are medians; the models are measured alternately. The script
trains no model and changes none of the given files.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
import onnx

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from fdda_addon.core.errors import FDDAError  # noqa: E402
from fdda_addon.runtime.network import Network  # noqa: E402

CROWD_SIZE = 20
CACHE_FLUSH_BYTES = 32 << 20
"""Bytes to read before each cold call, to empty the caches of the processor."""
ROUNDS, TIMED_CALLS, WARM_UP_CALLS = 7, 40, 5
"""Per model and kind of call: rounds, and in each round the calls that are timed and those that come before them."""


def time_calls(network: Network, pose_count: int, flushing_memory: np.ndarray | None) -> list[float]:
    """Time the calls of one round, in milliseconds; read `flushing_memory` before each call unless it is None."""
    poses = np.repeat(network.info.rest_matrices[None], pose_count, axis=0)
    control_values = np.float32([[(control.low + control.high) / 2 for control in network.info.controls]] * pose_count)
    times = []
    for _ in range(WARM_UP_CALLS + TIMED_CALLS):
        if flushing_memory is not None:
            flushing_memory.sum()
        start = time.perf_counter()
        network.positions(poses, control_values if network.info.controls else None)
        times.append((time.perf_counter() - start) * 1000)
    return times[WARM_UP_CALLS:]


def measure(networks: list[Network]) -> list[dict[str, float]]:
    """Return the median milliseconds per call of each model, by kind of call: hot, cold, hot_crowd, cold_crowd."""
    flushing_memory = np.ones(CACHE_FLUSH_BYTES // 4, np.float32)
    call_kinds = {
        "hot": (1, None),
        "cold": (1, flushing_memory),
        "hot_crowd": (CROWD_SIZE, None),
        "cold_crowd": (CROWD_SIZE, flushing_memory),
    }
    times = [{kind: [] for kind in call_kinds} for _ in networks]
    for _ in range(ROUNDS):
        for network, network_times in zip(networks, times, strict=True):
            for kind, (pose_count, memory) in call_kinds.items():
                network_times[kind] += time_calls(network, pose_count, memory)
    return [{kind: float(np.median(values)) for kind, values in model_times.items()} for model_times in times]


def count_constants(path: Path) -> tuple[int, int]:
    """Return the number of nodes of a model and the bytes of its constants."""
    graph = onnx.load(path).graph
    return len(graph.node), sum(onnx.numpy_helper.to_array(tensor).nbytes for tensor in graph.initializer)


def main() -> int:
    """Measure the models and print the figures; return the exit status."""
    parser = argparse.ArgumentParser("model_cost", description=__doc__.partition("\n")[0])
    parser.add_argument("models", type=Path, nargs="+", help="model files that `train` wrote")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args()
    try:
        networks = [Network(path) for path in options.models]
    except FDDAError as error:
        print(error, file=sys.stderr)
        return 1
    rows = []
    header = (
        f"{'vertices':>8} {'nodes':>5} {'MB':>6} {'hot':>7} {'cold':>7} {'ratio':>5} {'of 20: hot':>10} {'cold':>7}"
    )
    print(header, " model")
    for path, network, times in zip(options.models, networks, measure(networks), strict=True):
        node_count, constant_bytes = count_constants(path)
        rows.append(
            {
                "model": str(path),
                "vertices": network.info.vertex_count,
                "nodes": node_count,
                "bytes": constant_bytes,
                **times,
            }
        )
        print(
            f"{network.info.vertex_count:8} {node_count:5} {constant_bytes / 1e6:6.2f} "
            f"{times['hot']:7.3f} {times['cold']:7.3f} {times['cold'] / times['hot']:5.2f} "
            f"{times['hot_crowd'] / CROWD_SIZE:10.3f} {times['cold_crowd'] / CROWD_SIZE:7.3f}"
            f"  {path}"
        )
    if options.json:
        options.json.write_text(
            json.dumps({"unit": "ms", "crowd": CROWD_SIZE, "models": rows}, indent=1), encoding="utf-8"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
