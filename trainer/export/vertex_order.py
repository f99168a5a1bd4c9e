# SPDX-License-Identifier: GPL-3.0-or-later
"""Order of the vertices in the graph: it converts positions from the order of the partitions to the order of the mesh.

In a large mesh, gathering vertices one by one takes as long as all matrix products. Most vertices have the same
partition as the vertices with adjacent indices, so most of the mesh can be gathered in blocks. A block with vertices of
several partitions is assembled from single vertices first.
"""

from dataclasses import dataclass

import numpy as np

from ..graph_builder import GraphBuilder

BLOCK_SIZE = 16
"""Number of vertices per block of a large mesh."""
MIN_BLOCK_VERTICES = 20_000
"""Blocks are used from this number of vertices on, if most vertices lie in whole blocks. In smaller meshes the
additional nodes take longer than they save: docs/experiments.md, What each mechanism brings."""


@dataclass(frozen=True)
class VertexOrder:
    """The order of the vertices in the products.

    Attributes:
        block_size: number of vertices per block.
        columns: for each partition, the vertex index of each of its columns; -1 for padding.
        vertex_count: V, number of vertices of the mesh.
    """

    block_size: int
    columns: tuple[np.ndarray, ...]
    vertex_count: int

    def add(self, graph: GraphBuilder, ordered_positions: str, output_name: str) -> None:
        """Add nodes that reorder (N, ·, 3) positions from the order of the columns to that of the mesh, (N, V, 3)."""
        all_columns, block_size = np.concatenate(self.columns), self.block_size
        column_of_vertex = np.zeros(-(-self.vertex_count // block_size) * block_size, np.int64)
        column_of_vertex[all_columns[all_columns >= 0]] = np.flatnonzero(all_columns >= 0)
        if block_size == 1:
            order = graph.short_integers("vertex_order", column_of_vertex)
            graph.add("Gather", [ordered_positions, order], output_name, axis=1)
            return
        is_padded = len(column_of_vertex) > self.vertex_count
        blocks = column_of_vertex.reshape(-1, block_size)
        is_whole = (blocks[:, 0] % block_size == 0) & (np.diff(blocks, axis=1) == 1).all(axis=1)
        is_whole[-1] &= not is_padded
        mixed_order = len(all_columns) // block_size + np.cumsum(~is_whole) - 1
        block_order = np.where(is_whole, blocks[:, 0] // block_size, mixed_order)
        vertex_blocks = graph.reshape(ordered_positions, [0, -1, 3 * block_size], "vertex_blocks")
        if not is_whole.all():
            mixed_blocks = graph.short_integers("mixed_vertices", blocks[~is_whole].ravel())
            mixed_blocks = graph.add("Gather", [ordered_positions, mixed_blocks], "mixed_positions", axis=1)
            mixed_blocks = graph.reshape(mixed_blocks, [0, -1, 3 * block_size], "mixed_blocks")
            vertex_blocks = graph.add("Concat", [vertex_blocks, mixed_blocks], "all_blocks", axis=1)
        order = graph.short_integers("block_order", block_order)
        vertex_blocks = graph.add("Gather", [vertex_blocks, order], "blocks_in_order", axis=1)
        shape = [0, len(column_of_vertex), 3]
        padded_positions = graph.reshape(vertex_blocks, shape, "padded_positions" if is_padded else output_name)
        if is_padded:
            graph.slice(padded_positions, 0, self.vertex_count, 1, output_name)


def vertex_order(vertices_of_partitions: list[np.ndarray]) -> VertexOrder:
    """Choose the block size. Each partition has its vertices in whole blocks first.

    Args:
        vertices_of_partitions: (Vp,) vertex indices of each partition, ascending.
    """
    vertex_count = sum(len(vertices) for vertices in vertices_of_partitions)
    partition_by_vertex = np.empty(vertex_count, np.int64)
    for index, vertices in enumerate(vertices_of_partitions):
        partition_by_vertex[vertices] = index
    is_whole, columns = _is_in_whole_block(partition_by_vertex, BLOCK_SIZE), []
    block_size = BLOCK_SIZE if vertex_count >= MIN_BLOCK_VERTICES and is_whole.mean() > 0.5 else 1
    for vertices in vertices_of_partitions:
        padding = np.full(-len(vertices) % block_size, -1)
        columns.append(np.concatenate([vertices[is_whole[vertices]], vertices[~is_whole[vertices]], padding]))
    return VertexOrder(block_size, tuple(columns), vertex_count)


def _is_in_whole_block(partition_by_vertex: np.ndarray, block_size: int) -> np.ndarray:
    """Return (V,) bool, which vertices lie in a block of adjacent indices that all have the same partition."""
    padding = np.full(-len(partition_by_vertex) % block_size, -1)
    blocks = np.append(partition_by_vertex, padding).reshape(-1, block_size)
    return np.repeat((blocks == blocks[:, :1]).all(axis=1), block_size)[: len(partition_by_vertex)]
