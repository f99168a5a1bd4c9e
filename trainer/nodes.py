# SPDX-License-Identifier: GPL-3.0-or-later
"""Nodes and constants of an ONNX graph that is being built."""

import numpy as np
import onnx
from onnx import helper, numpy_helper


class Graph:
    """Nodes and constants, named as they are added."""

    def __init__(self):
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def _constant(self, name: str, value: np.ndarray) -> str:
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def floats(self, name: str, value: np.ndarray) -> str:
        return self._constant(name, np.asarray(value, np.float32))

    def integers(self, name: str, value: np.ndarray) -> str:
        return self._constant(name, np.asarray(value, np.int64))

    def short_integers(self, name: str, value: np.ndarray) -> str:
        """For long indices: a frame reads them all."""
        return self._constant(name, np.asarray(value, np.int32))

    def add(self, operator: str, inputs: list[str], output: str, **attributes) -> str:
        self.nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    def join(self, values: list[str], output: str, axis: int) -> str:
        """Concat; a single value is itself."""
        return self.add("Concat", values, output, axis=axis) if len(values) > 1 else values[0]

    def split(self, value: str, sizes: list[int], outputs: list[str], axis: int) -> list[str]:
        """Split; a single part is the value itself."""
        if len(sizes) == 1:
            return [value]
        inputs = [value, self.integers(f"{outputs[0]}_sizes", sizes)]
        self.nodes.append(helper.make_node("Split", inputs, outputs, name=f"{outputs[0]}_split", axis=axis))
        return outputs

    def slice(self, value: str, start: int, end: int, axis: int, output: str) -> str:
        bounds = (self.integers(f"{output}_{key}", [v]) for key, v in (("start", start), ("end", end), ("axis", axis)))
        return self.add("Slice", [value, *bounds], output)

    def reshape(self, value: str, shape: list[int], output: str) -> str:
        return self.add("Reshape", [value, self.integers(f"{output}_shape", shape)], output)
