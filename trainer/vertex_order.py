# SPDX-License-Identifier: GPL-3.0-or-later
"""From the order of the partitions back to that of the mesh, in blocks of neighbors.

To gather vertices one by one takes as long as all products of a large mesh. Most vertices have neighbors of the same
partition before and behind them, so most of the mesh can be gathered in blocks; blocks that lie in several partitions
are put together first.
"""

from dataclasses import dataclass

import numpy as np

from .nodes import Graph

GATHERED_NS, COPIED_NS, NODES_NS = 9, 0.4, 3000
"""A piece that is gathered, a vertex that is copied, and the nodes that blocks take more: nanoseconds, measured."""
SIZES = (1, 4, 8, 16, 32)


@dataclass(frozen=True)
class VertexOrder:
    """How the vertices lie in the products.

    Attributes:
        size: vertices of a block.
        columns: for each partition, the vertices of its columns; -1 for padding.
        vertices: V.
    """

    size: int
    columns: tuple[np.ndarray, ...]
    vertices: int

    def add(self, graph: Graph, joined: str, output: str) -> None:
        """(N, columns, 3) positions in the order of the columns to (N, V, 3) in that of the mesh."""
        everything, size = np.concatenate(self.columns), self.size
        place = np.zeros(-(-self.vertices // size) * size, np.int64)
        place[everything[everything >= 0]] = np.flatnonzero(everything >= 0)
        if size == 1:
            graph.add("Gather", [joined, graph.short_integers("vertex_order", place)], output, axis=1)
            return
        blocks = place.reshape(-1, size)
        whole = _whole(blocks)
        if self.vertices % size:
            whole[-1] = False
        order = np.where(whole, blocks[:, 0] // size, len(everything) // size + np.cumsum(~whole) - 1)
        pieces = graph.reshape(joined, [0, -1, 3 * size], "vertex_blocks")
        if not whole.all():
            mixed = graph.short_integers("mixed_vertices", blocks[~whole].ravel())
            mixed = graph.add("Gather", [joined, mixed], "mixed_positions", axis=1)
            mixed = graph.reshape(mixed, [0, -1, 3 * size], "mixed_blocks")
            pieces = graph.add("Concat", [pieces, mixed], "all_blocks", axis=1)
        pieces = graph.add("Gather", [pieces, graph.short_integers("block_order", order)], "blocks_in_order", axis=1)
        padded = len(place) > self.vertices
        shape = [0, len(place), 3]
        ordered = graph.reshape(pieces, shape, "padded_positions" if padded else output)
        if padded:
            graph.slice(ordered, 0, self.vertices, 1, output)


def _whole(blocks: np.ndarray) -> np.ndarray:
    """(n,) which of the (n, size) places are one block of the columns."""
    size = blocks.shape[1]
    return (blocks[:, 0] % size == 0) & (np.diff(blocks, axis=1) == 1).all(axis=1)


def vertex_order(partitions: list[np.ndarray]) -> VertexOrder:
    """Choose the blocks that take the least time.

    Args:
        partitions: (Vp,) vertices of each, ascending.
    """
    vertices = sum(len(own) for own in partitions)
    owner = np.empty(vertices, np.int64)
    for number, own in enumerate(partitions):
        owner[own] = number

    def cost(size: int) -> float:
        if size == 1:
            return GATHERED_NS * vertices
        count = vertices // size
        mixed = (np.diff(owner[: count * size].reshape(count, size), axis=1) != 0).any(axis=1).sum()
        mixed += vertices % size > 0
        copies = 2 if vertices % size else 1
        return GATHERED_NS * (count + mixed * size) + COPIED_NS * vertices * (copies + 1) + NODES_NS

    size = min(SIZES, key=cost)
    return VertexOrder(
        size, tuple(_columns(own, owner, number, size) for number, own in enumerate(partitions)), vertices
    )


def _columns(own: np.ndarray, owner: np.ndarray, number: int, size: int) -> np.ndarray:
    """The vertices of a partition, those of whole blocks first, padded to whole blocks."""
    if size == 1:
        return own
    padded = np.append(owner, np.full(-len(owner) % size, -1))
    inside = np.repeat((padded.reshape(-1, size) == number).all(axis=1), size)[: len(owner)][own]
    return np.concatenate([own[inside], own[~inside], np.full(-len(own) % size, -1)])
