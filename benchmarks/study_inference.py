# SPDX-License-Identifier: GPL-3.0-or-later
"""How long models take for one pose, as the add-on plays them: ONNX Runtime, one thread."""

import statistics
import time
from pathlib import Path

import numpy as np

from fdda_addon.runtime.network import Network

ROUNDS = 40
CALLS = 20
"""In a round each model is called so often in a row; then the next one's turn comes."""


def inference_times(models: list[list[Path]], pose: np.ndarray) -> list[list[float]]:
    """Time models in turns, all in this process.

    Args:
        models: files, a list for each configuration.
        pose: (1, J, 4, 4) float32, mesh-object space, mesh units.

    Returns:
        Microseconds a call, the median for each model, in the same order.
    """
    networks = [[Network(path) for path in paths] for paths in models]
    times: list[list[list[float]]] = [[[] for _ in paths] for paths in models]
    for _ in range(ROUNDS):
        # Across the configurations first: a disturbance that lasts a round then meets all of them.
        for number in range(max(len(paths) for paths in models)):
            for own, kept in zip(networks, times, strict=True):
                if number < len(own):
                    kept[number] += _calls(own[number], pose)
    return [[round(statistics.median(model) * 1e6, 1) for model in kept] for kept in times]


def _calls(network: Network, pose: np.ndarray) -> list[float]:
    network.positions(pose)
    seconds = []
    for _ in range(CALLS):
        start = time.perf_counter()
        network.positions(pose)
        seconds.append(time.perf_counter() - start)
    return seconds
