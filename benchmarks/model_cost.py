# SPDX-License-Identifier: GPL-3.0-or-later
"""What models cost by themselves: `python benchmarks/model_cost.py MODEL.onnx … [--json OUT.json]`.

Prints the nodes of each, the bytes of constants that a frame reads, and the milliseconds a character of one pose and of
twenty in a call: hot, in a loop, and cold, after other memory has been read, as Blender does in a frame. Medians, the
models in turns. Nothing is trained, Blender is not needed, and no file that is given is changed.
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

CROWD = 20
CACHE_FLUSH_BYTES = 32 << 20
"""Read between two cold calls."""
ROUNDS, RUNS = 7, 40
"""Of every model and way; the first few runs of a turn only warm up."""


def time_calls(network: Network, count: int, swept: np.ndarray | None) -> list[float]:
    """Times of one turn: `RUNS` calls of so many poses each, with a sweep before each where there is one."""
    poses = np.repeat(network.info.rest_matrices[None], count, axis=0)
    values = np.float32([[(control.low + control.high) / 2 for control in network.info.controls]] * count)
    times = []
    for _ in range(RUNS + 5):
        if swept is not None:
            swept.sum()
        start = time.perf_counter()
        network.positions(poses, values if network.info.controls else None)
        times.append((time.perf_counter() - start) * 1000)
    return times[5:]


def measure(networks: list[Network]) -> list[dict[str, float]]:
    """Median milliseconds a call of each model, by `hot`, `cold` and the same of a crowd."""
    swept = np.ones(CACHE_FLUSH_BYTES // 4, np.float32)
    ways = {"hot": (1, None), "cold": (1, swept), "hot_crowd": (CROWD, None), "cold_crowd": (CROWD, swept)}
    times = [{way: [] for way in ways} for _ in networks]
    for _ in range(ROUNDS):
        for network, own in zip(networks, times, strict=True):
            for way, (count, memory) in ways.items():
                own[way] += time_calls(network, count, memory)
    return [{way: float(np.median(values)) for way, values in own.items()} for own in times]


def count_constants(path: Path) -> tuple[int, int]:
    """Nodes of a model, and bytes of its constants."""
    graph = onnx.load(path).graph
    return len(graph.node), sum(onnx.numpy_helper.to_array(tensor).nbytes for tensor in graph.initializer)


def main() -> int:
    """Measure and print; returns the exit status."""
    parser = argparse.ArgumentParser("model_cost", description=__doc__.partition("\n")[0])
    parser.add_argument("models", type=Path, nargs="+", help="files that train made")
    parser.add_argument("--json", type=Path, help="where the figures go too")
    options = parser.parse_args()
    try:
        networks = [Network(path) for path in options.models]
    except FDDAError as error:
        print(error, file=sys.stderr)
        return 1
    rows = []
    heads = f"{'vertices':>8} {'nodes':>5} {'MB':>6} {'hot':>7} {'cold':>7} {'ratio':>5} {'of 20: hot':>10} {'cold':>7}"
    print(heads, " model")
    for path, network, times in zip(options.models, networks, measure(networks), strict=True):
        nodes, read = count_constants(path)
        rows.append({"model": str(path), "vertices": network.info.vertex_count, "nodes": nodes, "bytes": read, **times})
        print(
            f"{network.info.vertex_count:8} {nodes:5} {read / 1e6:6.2f} {times['hot']:7.3f} {times['cold']:7.3f} "
            f"{times['cold'] / times['hot']:5.2f} {times['hot_crowd'] / CROWD:10.3f} {times['cold_crowd'] / CROWD:7.3f}"
            f"  {path}"
        )
    if options.json:
        options.json.write_text(json.dumps({"unit": "ms", "crowd": CROWD, "models": rows}, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
