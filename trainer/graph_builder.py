# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds the nodes and constants of an ONNX graph."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

FLOAT = TensorProto.FLOAT
MAX_SHORT = np.iinfo(np.int16).max


def compact(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return floats as int16 integers, and the float32 scale of each row along the last axis."""
    scales = np.abs(values).max(axis=-1, keepdims=True).astype(np.float32) / MAX_SHORT
    scales[scales == 0] = 1
    return np.rint(values / scales).astype(np.int16), scales


class GraphBuilder:
    """Collects nodes and constants. Each method returns the name of the value that it added."""

    def __init__(self):
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def _constant(self, name: str, value: np.ndarray) -> str:
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def floats(self, name: str, value: np.ndarray) -> str:
        """Add a float32 constant."""
        return self._constant(name, np.asarray(value, np.float32))

    def compact_floats(self, name: str, value: np.ndarray) -> str:
        """Add floats that the file holds as 16-bit integers, with a scale for each row along the last axis.

        ONNX Runtime computes the float32 constant while it loads the model, so that a run takes no longer.
        """
        integers, scales = compact(value)
        integers = self.add("Cast", [self._constant(f"{name}_integers", integers)], f"{name}_rounded", to=FLOAT)
        return self.add("Mul", [integers, self.floats(f"{name}_scales", scales)], name)

    def integers(self, name: str, value: np.ndarray) -> str:
        """Add an int64 constant."""
        return self._constant(name, np.asarray(value, np.int64))

    def short_integers(self, name: str, value: np.ndarray) -> str:
        """Add an int32 constant. Large index arrays use this type, because every evaluation reads all indices."""
        return self._constant(name, np.asarray(value, np.int32))

    def add(self, operator: str, inputs: list[str], output: str, **attributes) -> str:
        """Add a node with one output."""
        self.nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    def join(self, values: list[str], output: str, axis: int) -> str:
        """Concatenate values; a single value needs no node."""
        return self.add("Concat", values, output, axis=axis) if len(values) > 1 else values[0]

    def split(self, value: str, sizes: list[int], outputs: list[str], axis: int) -> list[str]:
        """Split a value; a single part needs no node."""
        if len(sizes) == 1:
            return [value]
        inputs = [value, self.integers(f"{outputs[0]}_sizes", sizes)]
        self.nodes.append(helper.make_node("Split", inputs, outputs, name=f"{outputs[0]}_split", axis=axis))
        return outputs

    def slice(self, value: str, start: int, end: int, axis: int, output: str) -> str:
        """Take the elements from `start` to before `end` along an axis."""
        bounds = (self.integers(f"{output}_{key}", [v]) for key, v in (("start", start), ("end", end), ("axis", axis)))
        return self.add("Slice", [value, *bounds], output)

    def reshape(self, value: str, shape: list[int], output: str) -> str:
        """Reshape a value; 0 keeps a dimension, -1 infers it."""
        return self.add("Reshape", [value, self.integers(f"{output}_shape", shape)], output)
