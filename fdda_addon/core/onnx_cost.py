# SPDX-License-Identifier: GPL-3.0-or-later
"""Cost of running a graph, computed by shape inference without running it.

`SHAPE_RULES` has the operators that a model may use, which are the operators that `train` writes. To support another
operator, add it with a rule that computes the shapes of its outputs (https://onnx.ai/onnx/operators/).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from .onnx_file import OnnxConstant, OnnxContents, OnnxNode

Shape = tuple[int, ...]
MAX_ELEMENTS = 1 << 40
"""Largest number of elements of the outputs of a node."""


@dataclass
class GraphCost:
    """Cost of running a graph.

    Attributes:
        elements: number of elements of all outputs of nodes.
        products: number of multiplications in matrix products.
        shapes: shapes of the values, by name.
    """

    elements: int
    products: int
    shapes: dict[str, Shape]


@dataclass
class _NodeCall:
    """A node with the shapes of its inputs, and its constant inputs; None for an input that is not constant."""

    node: OnnxNode
    shapes: list[Shape]
    constants: list[OnnxConstant | None]

    def attribute(self, name: str, default: int) -> int:
        """Return an integer attribute of the node; raise ValueError where it has another type."""
        value = self.node.attributes.get(name, default)
        if not isinstance(value, int):
            raise ValueError(f"a {self.node.operator} whose {name} is no whole number")
        return value

    def integers(self, input_index: int) -> tuple[int, ...]:
        """Return the elements of an input, which must be a short constant; `input_index` is its index."""
        if input_index >= len(self.constants) or self.constants[input_index] is None:
            raise ValueError(f"a {self.node.operator} whose sizes are no constants")
        return self.constants[input_index].integers()

    def axis(self, rank: int, name: str = "axis", default: int = 0) -> int:
        """Return an attribute that is an axis of a value with `rank` dimensions, 0 to rank - 1."""
        return _normalize_axis(self.attribute(name, default), rank)


def _normalize_axis(axis: int, rank: int) -> int:
    """Convert an axis, which may count from the end, to 0 to rank - 1; raise ValueError where it does not exist."""
    if not -rank <= axis < rank:
        raise ValueError(f"a value of {rank} dimensions has no axis {axis}")
    return axis % rank


def _broadcast_shapes(shapes: Sequence[Shape]) -> Shape:
    result: Shape = ()
    for shape in shapes:
        rank = max(len(result), len(shape))
        pairs = zip((1,) * (rank - len(result)) + result, (1,) * (rank - len(shape)) + shape, strict=True)
        broadcast = []
        for result_size, size in pairs:
            if result_size != size and 1 not in (result_size, size):
                raise ValueError(f"values of the shapes {' and '.join(map(str, shapes))} do not fit")
            broadcast.append(size if result_size == 1 else result_size)
        result = tuple(broadcast)
    return result


def _same_shape(call: _NodeCall) -> list[Shape]:
    return [call.shapes[0]]


def _elementwise(call: _NodeCall) -> list[Shape]:
    return [_broadcast_shapes(call.shapes)]


def _matmul(call: _NodeCall) -> list[Shape]:
    left, right = call.shapes[:2]
    if min(len(left), len(right)) < 2 or left[-1] != right[-2]:
        raise ValueError(f"matrices of {left} and {right} have no product")
    return [(*_broadcast_shapes((left[:-2], right[:-2])), left[-2], right[-1])]


def _gemm(call: _NodeCall) -> list[Shape]:
    left, right = call.shapes[:2]
    left, right = (
        shape[::-1] if call.attribute(name, 0) else shape for name, shape in (("transA", left), ("transB", right))
    )
    if len(left) != 2 or len(right) != 2 or left[1] != right[0]:
        raise ValueError(f"matrices of {left} and {right} have no product")
    shape = (left[0], right[1])
    if _broadcast_shapes((shape, *call.shapes[2:])) != shape:
        raise ValueError("a Gemm adds what is larger than its product")
    return [shape]


def _transpose(call: _NodeCall) -> list[Shape]:
    shape = call.shapes[0]
    order = call.node.attributes.get("perm") or tuple(reversed(range(len(shape))))
    if not isinstance(order, tuple) or sorted(order) != list(range(len(shape))):
        raise ValueError("a Transpose whose axes are none")
    return [tuple(shape[axis] for axis in order)]


def _reshape(call: _NodeCall) -> list[Shape]:
    shape, new_shape = call.shapes[0], list(call.integers(1))
    if call.attribute("allowzero", 0) == 0:
        new_shape = [shape[i] if size == 0 and i < len(shape) else size for i, size in enumerate(new_shape)]
    if new_shape.count(-1) == 1:
        known_elements = math.prod(size for size in new_shape if size != -1)
        new_shape[new_shape.index(-1)] = math.prod(shape) // known_elements if known_elements > 0 else 0
    if min(new_shape, default=0) < 0 or math.prod(new_shape) != math.prod(shape):
        raise ValueError(f"a value of {shape} cannot be given the shape {tuple(new_shape)}")
    return [tuple(new_shape)]


def _concat(call: _NodeCall) -> list[Shape]:
    first_shape = call.shapes[0]
    axis = call.axis(len(first_shape))
    if any(
        len(other_shape) != len(first_shape)
        or (*other_shape[:axis], *other_shape[axis + 1 :]) != (*first_shape[:axis], *first_shape[axis + 1 :])
        for other_shape in call.shapes
    ):
        raise ValueError("values of different shapes are joined")
    return [(*first_shape[:axis], sum(shape[axis] for shape in call.shapes), *first_shape[axis + 1 :])]


def _split(call: _NodeCall) -> list[Shape]:
    shape, sizes = call.shapes[0], call.integers(1)
    axis = call.axis(len(shape))
    if min(sizes, default=-1) < 0 or sum(sizes) != shape[axis] or len(sizes) != len(call.node.outputs):
        raise ValueError("a value is split into parts that it does not have")
    return [(*shape[:axis], size, *shape[axis + 1 :]) for size in sizes]


def _slice(call: _NodeCall) -> list[Shape]:
    shape = list(call.shapes[0])
    starts, ends = call.integers(1), call.integers(2)
    axes = call.integers(3) if len(call.shapes) > 3 else tuple(range(len(starts)))
    steps = call.integers(4) if len(call.shapes) > 4 else (1,) * len(starts)
    if not len(starts) == len(ends) == len(axes) == len(steps) or 0 in steps:
        raise ValueError("a Slice whose bounds are none")
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        axis_index = _normalize_axis(axis, len(shape))
        shape[axis_index] = len(range(*slice(start, end, step).indices(shape[axis_index])))
    return [tuple(shape)]


def _gather(call: _NodeCall) -> list[Shape]:
    shape, index_shape = call.shapes[:2]
    axis = call.axis(len(shape))
    return [(*shape[:axis], *index_shape, *shape[axis + 1 :])]


def _reduce(call: _NodeCall) -> list[Shape]:
    shape = call.shapes[0]
    axes = {_normalize_axis(axis, len(shape)) for axis in call.integers(1)}
    if call.attribute("keepdims", 1):
        return [tuple(1 if axis in axes else size for axis, size in enumerate(shape))]
    return [tuple(size for axis, size in enumerate(shape) if axis not in axes)]


SHAPE_RULES: dict[str, Callable[[_NodeCall], list[Shape]]] = {
    **dict.fromkeys(("Add", "Sub", "Mul", "Div", "Max", "Min"), _elementwise),
    **dict.fromkeys(("Relu", "Sigmoid", "Tanh", "Erf", "Sqrt"), _same_shape),
    **{"MatMul": _matmul, "Gemm": _gemm, "Transpose": _transpose, "Reshape": _reshape, "Concat": _concat},
    **{"Split": _split, "Slice": _slice, "Gather": _gather, "ReduceSum": _reduce},
}
OPERATORS = tuple(SHAPE_RULES)


def compute_graph_cost(contents: OnnxContents, poses: int) -> GraphCost:
    """Infer the shapes of all values of a graph, and compute its cost.

    Args:
        contents: contents of the file. The first dimension of each input is the number of poses.
        poses: number of poses.

    Raises:
        ValueError: an operator is not one of `OPERATORS`, or the shapes of values do not match. The message is a clause
            about the graph.
    """
    input_shapes = {name: (poses, *shape[1:]) for name, shape in contents.inputs.items()}
    constant_shapes = {name: constant.shape for name, constant in contents.constants.items()}
    cost = GraphCost(0, 0, {**input_shapes, **constant_shapes})
    if len(cost.shapes) != len(input_shapes) + len(constant_shapes):
        raise ValueError("an input and a constant have one name")
    for node in contents.nodes:
        _add_node(node, contents.constants, cost)
    return cost


def _add_node(node: OnnxNode, constants: dict[str, OnnxConstant], cost: GraphCost) -> None:
    if node.operator not in SHAPE_RULES:
        raise ValueError(f"it has the operator {node.operator!r}, which train does not write")
    inputs = [name for name in node.inputs if name]
    if not inputs or (missing := [name for name in inputs if name not in cost.shapes]):
        raise ValueError(
            f"a {node.operator} takes {missing[0]!r}, which nothing gives" if inputs else "a node takes nothing"
        )
    call = _NodeCall(node, [cost.shapes[name] for name in inputs], [constants.get(name) for name in inputs])
    try:
        output_shapes = SHAPE_RULES[node.operator](call)
    except IndexError as error:
        raise ValueError(f"a {node.operator} has too few inputs") from error
    if len(node.outputs) > len(output_shapes):
        raise ValueError(f"a {node.operator} gives too many values")
    elements = sum(math.prod(shape) for shape in output_shapes)
    if elements > MAX_ELEMENTS:
        raise ValueError(
            f"a {node.operator} gives {elements} numbers, more than its joints, vertices and components explain"
        )
    cost.elements += elements
    if node.operator in ("MatMul", "Gemm"):
        cost.products += math.prod(output_shapes[0]) * call.shapes[0][-1 if not call.attribute("transA", 0) else -2]
    if None not in call.constants:
        # ONNX Runtime would compute the outputs while it loads the graph; `train` stores them as constants.
        raise ValueError(f"a {node.operator} of constants alone")
    for name, shape in zip(node.outputs, output_shapes, strict=False):
        if name in cost.shapes:
            raise ValueError(f"two values are called {name!r}")
        cost.shapes[name] = shape
