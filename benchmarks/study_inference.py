# SPDX-License-Identifier: GPL-3.0-or-later
"""Time models on one pose with the settings of the add-on: ONNX Runtime with one thread."""

import statistics
import time
from pathlib import Path

import numpy as np

from fdda_addon.runtime.network import Network

ROUNDS = 40
CALLS_PER_ROUND = 20
"""Successive calls of each model in a round."""


def inference_times(models: list[list[Path]], pose: np.ndarray) -> list[list[float]]:
    """Time models alternately in this process.

    Args:
        models: model files, one list for each configuration.
        pose: (1, J, 4, 4) float32, mesh-object space, mesh units.

    Returns:
        Median microseconds per call for each model, in the same order.
    """
    networks = [[Network(path) for path in paths] for paths in models]
    times: list[list[list[float]]] = [[[] for _ in paths] for paths in models]
    for _ in range(ROUNDS):
        # Take one model of each configuration in turn: a disturbance that lasts a round then affects all of them.
        for index in range(max(len(paths) for paths in models)):
            for configuration_networks, configuration_times in zip(networks, times, strict=True):
                if index < len(configuration_networks):
                    configuration_times[index] += _time_calls(configuration_networks[index], pose)
    return [
        [round(statistics.median(model_times) * 1e6, 1) for model_times in configuration_times]
        for configuration_times in times
    ]


def _time_calls(network: Network, pose: np.ndarray) -> list[float]:
    network.positions(pose)
    seconds = []
    for _ in range(CALLS_PER_ROUND):
        start = time.perf_counter()
        network.positions(pose)
        seconds.append(time.perf_counter() - start)
    return seconds
