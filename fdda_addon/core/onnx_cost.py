# SPDX-License-Identifier: GPL-3.0-or-later
"""Cost of running a graph, from shape inference without running it.

`SHAPE_RULES` has the operators that a model may use, which are those that `train` writes. An exporter that needs
another operator adds it with the rule for its shape (https://onnx.ai/onnx/operators/).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from .onnx_file import INT64, ITEM_BYTES, OnnxConstant, OnnxContents, OnnxNode

Shape = tuple[int, ...]
MAX_ELEMENTS = 1 << 40
"""Largest number of elements of a value."""


@dataclass
class GraphCost:
    """Cost of running a graph.

    Attributes:
        elements: number of elements of all outputs of nodes.
        products: number of multiplications in matrix products.
        folded: number of elements computed from constants alone, when the graph is loaded.
        shapes: shapes of the values, by name.
    """

    elements: int
    products: int
    folded: int
    shapes: dict[str, Shape]


@dataclass
class _NodeCall:
    """A node with the shapes of its inputs, and its constant inputs."""

    node: OnnxNode
    shapes: list[Shape]
    constants: list[OnnxConstant | None]

    def attribute(self, name: str, default: int) -> int:
        value = self.node.attributes.get(name, default)
        if not isinstance(value, int):
            raise ValueError(f"a {self.node.operator} whose {name} is no whole number")
        return value

    def integers(self, number: int) -> tuple[int, ...]:
        """Read the elements of an input that must be a short constant."""
        if number >= len(self.constants) or self.constants[number] is None:
            raise ValueError(f"a {self.node.operator} whose sizes are no constants")
        return self.constants[number].integers()

    def axis(self, rank: int, name: str = "axis", default: int = 0) -> int:
        return _axis(self.attribute(name, default), rank)


def _axis(axis: int, rank: int) -> int:
    if not -rank <= axis < rank:
        raise ValueError(f"a value of {rank} dimensions has no axis {axis}")
    return axis % rank


def _broadcast(shapes: Sequence[Shape]) -> Shape:
    result: Shape = ()
    for shape in shapes:
        rank = max(len(result), len(shape))
        pairs = zip((1,) * (rank - len(result)) + result, (1,) * (rank - len(shape)) + shape, strict=True)
        joined = []
        for one, other in pairs:
            if one != other and 1 not in (one, other):
                raise ValueError(f"values of the shapes {' and '.join(map(str, shapes))} do not fit")
            joined.append(other if one == 1 else one)
        result = tuple(joined)
    return result


def _same_shape(call: _NodeCall) -> list[Shape]:
    return [call.shapes[0]]


def _elementwise(call: _NodeCall) -> list[Shape]:
    return [_broadcast(call.shapes)]


def _cast(call: _NodeCall) -> list[Shape]:
    if call.attribute("to", 0) not in ITEM_BYTES:
        raise ValueError("a Cast to what is no number")
    return [call.shapes[0]]


def _matmul(call: _NodeCall) -> list[Shape]:
    left, right = call.shapes[:2]
    if min(len(left), len(right)) < 2 or left[-1] != right[-2]:
        raise ValueError(f"matrices of {left} and {right} have no product")
    return [(*_broadcast((left[:-2], right[:-2])), left[-2], right[-1])]


def _gemm(call: _NodeCall) -> list[Shape]:
    left, right = call.shapes[:2]
    left, right = (
        shape[::-1] if call.attribute(name, 0) else shape for name, shape in (("transA", left), ("transB", right))
    )
    if len(left) != 2 or len(right) != 2 or left[1] != right[0]:
        raise ValueError(f"matrices of {left} and {right} have no product")
    shape = (left[0], right[1])
    if _broadcast((shape, *call.shapes[2:])) != shape:
        raise ValueError("a Gemm adds what is larger than its product")
    return [shape]


def _transpose(call: _NodeCall) -> list[Shape]:
    shape = call.shapes[0]
    order = call.node.attributes.get("perm") or tuple(reversed(range(len(shape))))
    if not isinstance(order, tuple) or sorted(order) != list(range(len(shape))):
        raise ValueError("a Transpose whose axes are none")
    return [tuple(shape[axis] for axis in order)]


def _reshape(call: _NodeCall) -> list[Shape]:
    shape, wanted = call.shapes[0], list(call.integers(1))
    if call.attribute("allowzero", 0) == 0:
        wanted = [shape[i] if size == 0 and i < len(shape) else size for i, size in enumerate(wanted)]
    if wanted.count(-1) == 1:
        rest = math.prod(size for size in wanted if size != -1)
        wanted[wanted.index(-1)] = math.prod(shape) // rest if rest > 0 else 0
    if min(wanted, default=0) < 0 or math.prod(wanted) != math.prod(shape):
        raise ValueError(f"a value of {shape} cannot be given the shape {tuple(wanted)}")
    return [tuple(wanted)]


def _concat(call: _NodeCall) -> list[Shape]:
    first = call.shapes[0]
    axis = call.axis(len(first))
    if any(
        len(s) != len(first) or (*s[:axis], *s[axis + 1 :]) != (*first[:axis], *first[axis + 1 :]) for s in call.shapes
    ):
        raise ValueError("values of different shapes are joined")
    return [(*first[:axis], sum(shape[axis] for shape in call.shapes), *first[axis + 1 :])]


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
        place = _axis(axis, len(shape))
        shape[place] = len(range(*slice(start, end, step).indices(shape[place])))
    return [tuple(shape)]


def _gather(call: _NodeCall) -> list[Shape]:
    shape, chosen = call.shapes[:2]
    axis = call.axis(len(shape))
    return [(*shape[:axis], *chosen, *shape[axis + 1 :])]


def _unsqueeze(call: _NodeCall) -> list[Shape]:
    shape, axes = list(call.shapes[0]), call.integers(1)
    places = sorted({_axis(axis, len(shape) + len(axes)) for axis in axes})
    if len(places) != len(axes):
        raise ValueError("an Unsqueeze that names an axis twice")
    for axis in places:
        shape.insert(axis, 1)
    return [tuple(shape)]


def _reduce(call: _NodeCall) -> list[Shape]:
    shape = call.shapes[0]
    axes = {_axis(axis, len(shape)) for axis in call.integers(1)}
    if call.attribute("keepdims", 1):
        return [tuple(1 if axis in axes else size for axis, size in enumerate(shape))]
    return [tuple(size for axis, size in enumerate(shape) if axis not in axes)]


def _quantize(call: _NodeCall) -> list[Shape]:
    return [call.shapes[0], (), ()]


SHAPE_RULES: dict[str, Callable[[_NodeCall], list[Shape]]] = {
    **dict.fromkeys(("Add", "Sub", "Mul", "Div", "Max", "Min"), _elementwise),
    **dict.fromkeys(("Relu", "Sigmoid", "Tanh", "Erf", "Sqrt"), _same_shape),
    **dict.fromkeys(("MatMul", "MatMulInteger"), _matmul),
    **{"Gemm": _gemm, "Cast": _cast, "DequantizeLinear": _same_shape, "DynamicQuantizeLinear": _quantize},
    **{"Transpose": _transpose, "Reshape": _reshape, "Concat": _concat, "Split": _split, "Slice": _slice},
    **{"Gather": _gather, "Unsqueeze": _unsqueeze, "ReduceSum": _reduce},
}
OPERATORS = tuple(SHAPE_RULES)
MATRIX_PRODUCT_OPERATORS = ("MatMul", "MatMulInteger", "Gemm")
CONSTANT_INPUT_OPERATORS = ("Cast", "DequantizeLinear")
"""Operators whose inputs may all be constants; results of other operators would be stored as constants."""


def compute_graph_cost(contents: OnnxContents, poses: int) -> GraphCost:
    """Infer the shapes of all values of a graph, and add up its cost.

    Args:
        contents: of a file, its inputs with the number of poses as their first dimension.
        poses: number of poses.

    Raises:
        ValueError: an operator is not one of `OPERATORS`, or values do not fit; the text is a clause about the graph.
    """
    shapes = {name: (poses, *shape[1:]) for name, shape in contents.inputs.items()}
    fixed = {name: constant.shape for name, constant in contents.constants.items()}
    cost = GraphCost(0, 0, 0, {**shapes, **fixed})
    if len(cost.shapes) != len(shapes) + len(fixed):
        raise ValueError("an input and a constant have one name")
    constant_names = set(fixed)
    for node in contents.nodes:
        _add_node(node, contents.constants, constant_names, cost)
    return cost


def _add_node(node: OnnxNode, constants: dict[str, OnnxConstant], known: set[str], cost: GraphCost) -> None:
    if node.operator not in SHAPE_RULES:
        raise ValueError(f"it has the operator {node.operator!r}, which train does not write")
    inputs = [name for name in node.inputs if name]
    if not inputs or (missing := [name for name in inputs if name not in cost.shapes]):
        raise ValueError(
            f"a {node.operator} takes {missing[0]!r}, which nothing gives" if inputs else "a node takes nothing"
        )
    call = _NodeCall(node, [cost.shapes[name] for name in inputs], [constants.get(name) for name in inputs])
    try:
        found = SHAPE_RULES[node.operator](call)
    except IndexError as error:
        raise ValueError(f"a {node.operator} has too few inputs") from error
    if len(node.outputs) > len(found):
        raise ValueError(f"a {node.operator} gives too many values")
    elements = sum(math.prod(shape) for shape in found)
    if elements > MAX_ELEMENTS:
        raise ValueError(
            f"a {node.operator} gives {elements} numbers, more than its joints, vertices and components explain"
        )
    cost.elements += elements
    if node.operator in MATRIX_PRODUCT_OPERATORS:
        cost.products += math.prod(found[0]) * call.shapes[0][-1 if not call.attribute("transA", 0) else -2]
    if known.issuperset(inputs):
        if node.operator not in CONSTANT_INPUT_OPERATORS:
            raise ValueError(f"a {node.operator} of constants alone")
        cost.folded += elements
        known.update(node.outputs)
    for name, shape in zip(node.outputs, found, strict=False):
        if name in cost.shapes:
            raise ValueError(f"two values are called {name!r}")
        cost.shapes[name] = shape


def constant_elements(contents: OnnxContents) -> int:
    """Count the elements of the constants of a graph, without indices."""
    return sum(math.prod(c.shape) for c in contents.constants.values() if c.type != INT64)
