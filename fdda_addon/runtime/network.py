# SPDX-License-Identifier: GPL-3.0-or-later
"""Executes a model with ONNX Runtime."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..core.errors import ModelError
from ..core.model import (
    CONFIDENCE_OUTPUT,
    CONTROLS_INPUT,
    POSE_INPUT,
    POSITIONS_OUTPUT,
    check_model,
    read_model,
    read_skin,
)
from ..core.native_library import runtime_advice
from ..core.rig import Rig

THREADED_VERTICES = 100_000
"""From this many vertices on a second thread gains more than it costs."""
MAX_THREADS = 4
MAX_BOUND = 4
"""Numbers of poses for which arrays are kept."""


class Network:
    """A model that is ready to play.

    Attributes:
        path: the file.
        info: what the model says of itself.
    """

    def __init__(self, path: Path, data: bytes | None = None):
        """Load a model.

        Args:
            path: the file.
            data: its bytes, where it is no file; `path` is then what errors call it.

        Raises:
            ModelError: the file is no model or ONNX Runtime refuses it.
        """
        self.path = path
        self.info, data = read_model(path) if data is None else (check_model(data, path), data)
        self._skin = read_skin(data, self.info, path)
        try:
            # Imported here so that Blender starts without it.
            import onnxruntime
        except ImportError as error:
            version = ".".join(map(str, sys.version_info[:2]))
            advice = runtime_advice(str(error)) or (
                f"install the extension's zip for this platform and for Python {version}: 3.11 and 3.13 are in one, "
                "3.14 has its own"
            )
            raise ModelError(f"ONNX Runtime cannot be loaded by Python {version} ({error}); {advice}.") from error
        onnxruntime.set_default_logger_severity(3)
        onnxruntime.disable_telemetry_events()
        options = onnxruntime.SessionOptions()
        large = self.info.vertex_count >= THREADED_VERTICES
        options.intra_op_num_threads = min(MAX_THREADS, os.cpu_count() or 1) if large else 1
        options.inter_op_num_threads = 1
        # Threads that spin between frames would take the processor from Blender's own.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime's exceptions have no common base but this.
            raise ModelError(
                f"ONNX Runtime refuses the model '{path}' ({_first_line(error)}); train it again."
            ) from error
        self._executions: dict[int, Execution] = {}

    def positions(self, pose_matrices: np.ndarray, controls: np.ndarray | None = None) -> np.ndarray:
        """Deform the mesh.

        Args:
            pose_matrices: (N, J, 4, 4) float32, mesh-object space, mesh units.
            controls: (N, C) float32, values in the order of `info.controls`; a model without controls looks at none.

        Returns:
            (N, V, 3) float32, mesh-object space, mesh units. The array is the network's own: the next call with as many
            poses writes into it, so that a frame needs no new memory.

        Raises:
            ModelError: the model fails, or values of its controls are missing.
        """
        count = len(pose_matrices)
        if count not in self._executions:
            if len(self._executions) >= MAX_BOUND:
                self._executions.clear()
            self._executions[count] = Execution(self, count)
        execution = self._executions[count]
        execution.poses[:] = pose_matrices
        if self.info.controls:
            execution.controls[:] = self._controls(controls, count)
        return execution.run()

    def confidence(self, pose_matrices: np.ndarray, controls: np.ndarray | None = None) -> np.ndarray | None:
        """Evaluate the confidence of the networks; it takes as long as the positions, so not for every frame.

        Args:
            pose_matrices, controls: as for `positions`.

        Returns:
            (N, P) float32, 0 to 1, in the order of `info.partitions`; None when the model does not say.

        Raises:
            ModelError: the model fails, answers in another shape, or values of its controls are missing.
        """
        if CONFIDENCE_OUTPUT not in {output.name for output in self._session.get_outputs()}:
            return None
        inputs = {POSE_INPUT: pose_matrices}
        if self.info.controls:
            inputs[CONTROLS_INPUT] = np.asarray(self._controls(controls, len(pose_matrices)), np.float32)
        try:
            (confidence,) = self._session.run([CONFIDENCE_OUTPUT], inputs)
        except Exception as error:  # As above.
            raise ModelError(f"The model '{self.path}' failed ({_first_line(error)}); train it again.") from error
        if confidence.shape != (len(pose_matrices), len(self.info.partitions)):
            raise ModelError(f"The model '{self.path}' gives confidence of another shape than it says; train it again.")
        return confidence

    def linear_rig(self, rig: Rig) -> Rig:
        """A rig that the model fits, with the skin weights of the model's linear skinning, which may be fitted ones."""
        if self._skin is None:
            return rig
        joints, weights = self._skin
        return replace(rig, skin_joints=joints, skin_weights=weights)

    def _controls(self, controls: np.ndarray | None, count: int) -> np.ndarray:
        """Values of the controls, sure to be there and to be as many as the model takes."""
        shape, found = (count, len(self.info.controls)), None if controls is None else np.shape(controls)
        if found != shape:
            raise ModelError(
                f"The model '{self.path}' has {shape[1]} controls and takes their values as an array {shape}; "
                f"it was given {'none' if found is None else found}."
            )
        return controls


class Execution:
    """Executes a network with arrays of its own, so that several threads may execute one network at a time.

    Attributes:
        poses: (N, J, 4, 4) float32, to be written before `run`: pose matrices, mesh-object space, mesh units.
        controls: (N, C) float32, likewise: values in the order of `info.controls`.
        positions: (N, V, 3) float32, mesh-object space, mesh units: what the last `run` gave.
    """

    def __init__(self, network: Network, count: int):
        info = network.info
        self._path, self._session = network.path, network._session
        self.poses = np.zeros((count, len(info.joints), 4, 4), np.float32)
        self.controls = np.zeros((count, len(info.controls)), np.float32)
        self.positions = np.empty((count, info.vertex_count, 3), np.float32)
        self._binding = self._session.io_binding()
        self._binding.bind_input(POSE_INPUT, "cpu", 0, np.float32, self.poses.shape, self.poses.ctypes.data)
        if info.controls:
            address = self.controls.ctypes.data
            self._binding.bind_input(CONTROLS_INPUT, "cpu", 0, np.float32, self.controls.shape, address)
        address = self.positions.ctypes.data
        self._binding.bind_output(POSITIONS_OUTPUT, "cpu", 0, np.float32, self.positions.shape, address)

    def run(self) -> np.ndarray:
        """Deform the mesh; gives `positions`.

        Raises:
            ModelError: the model fails.
        """
        try:
            self._session.run_with_iobinding(self._binding)
        except Exception as error:  # As above.
            raise ModelError(f"The model '{self._path}' failed ({_first_line(error)}); train it again.") from error
        return self.positions


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0][:200]
