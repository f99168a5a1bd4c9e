# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs a model with ONNX Runtime."""

import os
import sys
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..core.errors import TRY_AGAIN, ModelError
from ..core.files.native_library import check_cpp_library, lacks_memory, runtime_advice
from ..core.formats.model import (
    CONFIDENCE_OUTPUT,
    CONTROLS_INPUT,
    POSE_INPUT,
    POSITIONS_OUTPUT,
    check_model,
    read_model,
    read_skin,
)
from ..core.rig import IDENTITY, STATIC_JOINT, Rig, mesh_slices

MIN_MULTITHREADED_VERTICES = 100_000
"""Smallest number of vertices for which several threads run the model; starting them takes time too."""
MAX_THREADS = 4


class Network:
    """A model that is loaded into ONNX Runtime, or a view of it that deforms one of its meshes (`of_mesh`).

    Attributes:
        path: path of the model file.
        info: metadata of the model; of a view, that of its mesh.
        model: the model itself, of a view too.
        vertices: the vertices of `info` in the output of the model.
        mesh_to_model: (4, 4) float64, from the space of the mesh object to that of the model; None for the identity.
        own_partitions: indices of the partitions with vertices of `info`; None until `confidence` has found them.
    """

    def __init__(self, path: Path, data: bytes | None = None):
        """Load a model.

        Args:
            path: path of the model file.
            data: the bytes of a model that is not in a file; `path` is then its name in error messages.

        Raises:
            ModelError: the file is not a model, or ONNX Runtime refuses it.
        """
        self.path = path
        self.info, data = read_model(path) if data is None else (check_model(data, path), data)
        self._skin = read_skin(data, self.info, path)
        try:
            check_cpp_library()
            # Imported here so that Blender starts without ONNX Runtime.
            import onnxruntime
        except (ImportError, OSError) as error:
            version = ".".join(map(str, sys.version_info[:2]))
            advice = runtime_advice(str(error), in_blender=True) or (
                f"install the extension's zip for this platform and for Python {version}: 3.11 and 3.13 are in one, "
                "3.14 has its own"
            )
            refusal = ModelError(f"ONNX Runtime cannot be loaded by Python {version} ({error}); {advice}.")
            if lacks_memory(str(error)):
                refusal.exit_status = TRY_AGAIN
            raise refusal from error
        onnxruntime.set_default_logger_severity(3)
        onnxruntime.disable_telemetry_events()
        session_options = onnxruntime.SessionOptions()
        is_large = self.info.vertex_count >= MIN_MULTITHREADED_VERTICES
        session_options.intra_op_num_threads = min(MAX_THREADS, os.cpu_count() or 1) if is_large else 1
        session_options.inter_op_num_threads = 1
        # Threads that spin between frames would take processor time from Blender.
        session_options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(data, session_options, providers=["CPUExecutionProvider"])
        except Exception as error:  # ONNX Runtime's exceptions have no other common base.
            raise ModelError(
                f"ONNX Runtime refuses the model '{path}' ({_first_line(error)}); train it again."
            ) from error
        self._execution: Execution | None = None
        self.model, self.vertices = self, slice(0, self.info.vertex_count)
        self.mesh_to_model: np.ndarray | None = None
        self.own_partitions: list[int] | None = None
        self._views: dict[str, Network] = {}

    def of_mesh(self, name: str) -> "Network":
        """Return a view of the model that deforms one of its meshes, given by its name, in the space of its object."""
        if len(self.info.meshes) > 1 and name not in self._views:
            parts = zip(self.info.meshes, mesh_slices(self.info.meshes), strict=True)
            mesh, vertices = next((mesh, vertices) for mesh, vertices in parts if mesh.name == name)
            view = self._views[name] = copy(self)
            view.info, view.vertices = self.info.of_mesh(mesh), vertices
            view.mesh_to_model = None if mesh.transform == IDENTITY else mesh.matrix
            view._skin = None if self._skin is None else tuple(values[vertices] for values in self._skin)
            view._execution, view._views, view.own_partitions = None, {}, None
        return self._views.get(name, self)

    def to_mesh_space(self, positions: np.ndarray) -> np.ndarray:
        """Transform positions, (..., V, 3) float32, from the space of the model to that of the mesh object."""
        if self.mesh_to_model is None:
            return positions
        matrix = np.linalg.inv(self.mesh_to_model)
        return positions @ matrix[:3, :3].T.astype(np.float32) + matrix[:3, 3].astype(np.float32)

    def _to_model_space(self, pose_matrices: np.ndarray) -> np.ndarray:
        """Transform pose matrices, (N, J, 4, 4), from the space of the mesh object to that of the model."""
        if self.mesh_to_model is None:
            return pose_matrices
        model_matrices = self.mesh_to_model @ pose_matrices
        model_matrices[:, [name == STATIC_JOINT for name in self.info.joint_names]] = np.eye(4)
        return model_matrices.astype(np.float32)

    def positions(self, pose_matrices: np.ndarray, controls: np.ndarray | None = None) -> np.ndarray:
        """Deform the mesh.

        Args:
            pose_matrices: (N, J, 4, 4) float32, mesh-object space, mesh units.
            controls: (N, C) float32, in the order of `info.controls`; ignored by a model without controls.

        Returns:
            (N, V, 3) float32, mesh-object space, mesh units. The next call with the same number of poses overwrites
            this array.

        Raises:
            ModelError: the model fails, or the values of its controls are missing.
        """
        pose_count = len(pose_matrices)
        if self._execution is None or pose_count != len(self._execution.poses):
            self._execution = Execution(self, pose_count)
        execution = self._execution
        execution.poses[:] = self._to_model_space(pose_matrices)
        if self.info.controls:
            execution.controls[:] = self._check_controls(controls, pose_count)
        return self.to_mesh_space(execution.run()[:, self.vertices])

    def confidence(self, pose_matrices: np.ndarray, controls: np.ndarray | None = None) -> np.ndarray | None:
        """Evaluate the confidence of each partition. This takes as long as `positions`, too long for each frame.

        Args:
            pose_matrices, controls: as for `positions`.

        Returns:
            (N, P) float32, 0 to 1, in the order of `info.partitions`; None if the model has no such output.

        Raises:
            ModelError: the model fails, its output has another shape, or the values of its controls are missing.
        """
        if CONFIDENCE_OUTPUT not in {output.name for output in self._session.get_outputs()}:
            return None
        inputs = {POSE_INPUT: self._to_model_space(pose_matrices)}
        if self.info.controls:
            inputs[CONTROLS_INPUT] = np.asarray(self._check_controls(controls, len(pose_matrices)), np.float32)
        try:
            (confidence,) = self._session.run([CONFIDENCE_OUTPUT], inputs)
        except Exception as error:  # ONNX Runtime's exceptions have no other common base.
            raise ModelError(f"The model '{self.path}' failed ({_first_line(error)}); train it again.") from error
        expected_shape = (len(pose_matrices), len(self.info.partitions))
        if confidence.shape != expected_shape:
            raise ModelError(
                f"The model '{self.path}' returns confidence of shape {confidence.shape}, not {expected_shape}; "
                "train it again."
            )
        return confidence

    def linear_rig(self, rig: Rig) -> Rig:
        """Return a rig with the skin weights of the model's linear skinning, which may have been fitted."""
        if self._skin is None:
            return rig
        joints, weights = self._skin
        return replace(rig, skin_joints=joints, skin_weights=weights)

    def _check_controls(self, controls: np.ndarray | None, pose_count: int) -> np.ndarray:
        """Return the values of the controls, (N, C), if they have the shape that the model takes."""
        expected_shape = (pose_count, len(self.info.controls))
        shape = None if controls is None else np.shape(controls)
        if shape != expected_shape:
            raise ModelError(
                f"The model '{self.path}' has {expected_shape[1]} controls and takes their values as an array "
                f"{expected_shape}; it was given {'none' if shape is None else shape}."
            )
        return controls


class Execution:
    """Input and output arrays of a model for a fixed number of poses. Each thread can run the model on its own arrays.

    All are in the space and the unit of the model, which are those of its first mesh.

    Attributes:
        poses: (N, J, 4, 4) float32, pose matrices. Set them before `run`.
        controls: (N, C) float32, in the order of `info.controls`. Set them before `run`.
        positions: (N, V, 3) float32, of the vertices of all meshes, written by `run`.
    """

    def __init__(self, network: Network, pose_count: int):
        info = network.model.info
        self._path, self._session = network.path, network._session
        self.poses = np.zeros((pose_count, len(info.joints), 4, 4), np.float32)
        self.controls = np.zeros((pose_count, len(info.controls)), np.float32)
        self.positions = np.empty((pose_count, info.vertex_count, 3), np.float32)
        self._io_binding = self._session.io_binding()
        self._io_binding.bind_input(POSE_INPUT, "cpu", 0, np.float32, self.poses.shape, self.poses.ctypes.data)
        if info.controls:
            address = self.controls.ctypes.data
            self._io_binding.bind_input(CONTROLS_INPUT, "cpu", 0, np.float32, self.controls.shape, address)
        address = self.positions.ctypes.data
        self._io_binding.bind_output(POSITIONS_OUTPUT, "cpu", 0, np.float32, self.positions.shape, address)

    def run(self) -> np.ndarray:
        """Run the model on `poses` and `controls`, and return `positions`.

        Raises:
            ModelError: the model fails.
        """
        try:
            self._session.run_with_iobinding(self._io_binding)
        except Exception as error:  # ONNX Runtime's exceptions have no other common base.
            raise ModelError(f"The model '{self._path}' failed ({_first_line(error)}); train it again.") from error
        return self.positions


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0][:200]
