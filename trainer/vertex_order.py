# SPDX-License-Identifier: GPL-3.0-or-later
"""Order of the vertices in the graph: conversion from the order of the partitions to the order of the mesh, in blocks.

Gathering vertices one by one takes as long as all products of a large mesh. Most vertices have neighbors in index order
of the same partition, so most of the mesh can be gathered in blocks. Blocks of several partitions are assembled first.
"""

from dataclasses import dataclass

import numpy as np

from .graph_builder import GraphBuilder

GATHER_NS, COPY_NS, EXTRA_NODES_NS = 9, 0.4, 3000
"""Measured time of a gathered slice, of a copied vertex, and of the additional nodes for blocks, nanoseconds."""
BLOCK_SIZES = (1, 4, 8, 16, 32)


@dataclass(frozen=True)
class VertexOrder:
    """The order of the vertices in the products.

    Attributes:
        block_size: vertices per block.
        columns: for each partition, the vertex of each of its columns; -1 for padding.
        vertex_count: V.
    """

    block_size: int
    columns: tuple[np.ndarray, ...]
    vertex_count: int

    def add(self, graph: GraphBuilder, joined: str, output: str) -> None:
        """Add nodes that convert (N, columns, 3) positions in column order to (N, V, 3) in mesh order.

        Args:
            graph: to add the nodes to.
            joined, output: names of input and output.
        """
        all_columns, size = np.concatenate(self.columns), self.block_size
        position = np.zeros(-(-self.vertex_count // size) * size, np.int64)
        position[all_columns[all_columns >= 0]] = np.flatnonzero(all_columns >= 0)
        if size == 1:
            graph.add("Gather", [joined, graph.short_integers("vertex_order", position)], output, axis=1)
            return
        blocks = position.reshape(-1, size)
        is_whole = _whole_blocks(blocks)
        if self.vertex_count % size:
            is_whole[-1] = False
        order = np.where(is_whole, blocks[:, 0] // size, len(all_columns) // size + np.cumsum(~is_whole) - 1)
        slices = graph.reshape(joined, [0, -1, 3 * size], "vertex_blocks")
        if not is_whole.all():
            mixed = graph.short_integers("mixed_vertices", blocks[~is_whole].ravel())
            mixed = graph.add("Gather", [joined, mixed], "mixed_positions", axis=1)
            mixed = graph.reshape(mixed, [0, -1, 3 * size], "mixed_blocks")
            slices = graph.add("Concat", [slices, mixed], "all_blocks", axis=1)
        slices = graph.add("Gather", [slices, graph.short_integers("block_order", order)], "blocks_in_order", axis=1)
        is_padded = len(position) > self.vertex_count
        shape = [0, len(position), 3]
        ordered = graph.reshape(slices, shape, "padded_positions" if is_padded else output)
        if is_padded:
            graph.slice(ordered, 0, self.vertex_count, 1, output)


def _whole_blocks(blocks: np.ndarray) -> np.ndarray:
    """Return (n,) bool, which of (n, size) positions are one block of the columns."""
    size = blocks.shape[1]
    return (blocks[:, 0] % size == 0) & (np.diff(blocks, axis=1) == 1).all(axis=1)


def vertex_order(partitions: list[np.ndarray]) -> VertexOrder:
    """Choose the block size that takes the least time.

    Args:
        partitions: (Vp,) vertices of each partition, ascending.
    """
    vertex_count = sum(len(vertices) for vertices in partitions)
    owner = np.empty(vertex_count, np.int64)
    for index, vertices in enumerate(partitions):
        owner[vertices] = index

    def cost(size: int) -> float:
        if size == 1:
            return GATHER_NS * vertex_count
        count = vertex_count // size
        mixed = (np.diff(owner[: count * size].reshape(count, size), axis=1) != 0).any(axis=1).sum()
        mixed += vertex_count % size > 0
        copies = 2 if vertex_count % size else 1
        return GATHER_NS * (count + mixed * size) + COPY_NS * vertex_count * (copies + 1) + EXTRA_NODES_NS

    size = min(BLOCK_SIZES, key=cost)
    columns = tuple(_columns(vertices, owner, index, size) for index, vertices in enumerate(partitions))
    return VertexOrder(size, columns, vertex_count)


def _columns(vertices: np.ndarray, owner: np.ndarray, index: int, size: int) -> np.ndarray:
    """Order the vertices of a partition: those of whole blocks first, padded to whole blocks."""
    if size == 1:
        return vertices
    padded = np.append(owner, np.full(-len(owner) % size, -1))
    is_whole = np.repeat((padded.reshape(-1, size) == index).all(axis=1), size)[: len(owner)][vertices]
    return np.concatenate([vertices[is_whole], vertices[~is_whole], np.full(-len(vertices) % size, -1)])
