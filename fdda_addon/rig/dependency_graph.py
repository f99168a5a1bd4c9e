# SPDX-License-Identifier: GPL-3.0-or-later
"""The graph of what needs what in a .blend file."""

from collections.abc import Hashable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple


class Node(NamedTuple):
    """A part of a .blend file.

    Attributes:
        datablock: the datablock.
        bone: name of a bone of the armature object `datablock`; empty for the datablock itself.
        driven_path: RNA path of a driven property of `datablock`; empty otherwise.
    """

    datablock: Hashable
    bone: str = ""
    driven_path: str = ""


@dataclass
class DependencyGraph:
    """What needs what. A node that occurs in no edge needs nothing.

    Attributes:
        needs: for each node, the nodes without which its evaluation would change.
    """

    needs: dict[Node, set[Node]] = field(default_factory=dict)

    def add(self, node: Node, *needed: Node) -> None:
        """Add that a node needs other nodes."""
        self.needs.setdefault(node, set()).update(needed)

    def add_chain(self, members: Iterable[Node]) -> None:
        """Add that nodes are solved together, so that each of them needs all others.

        An IK constraint moves the bones above its owner, so a bone in the chain depends on its descendant.
        """
        members = list(members)
        for first, second in zip(members, members[1:] + members[:1], strict=True):
            if first != second:
                self.add(first, second)

    @property
    def nodes(self) -> set[Node]:
        """Return all nodes that occur in an edge."""
        return set(self.needs).union(*self.needs.values())

    def kept(self, roots: Iterable[Node]) -> set[Node]:
        """Return the roots and all that they need, directly or through other nodes."""
        kept = set(roots)
        pending = list(kept)
        while pending:
            new_nodes = self.needs.get(pending.pop(), set()) - kept
            kept |= new_nodes
            pending += new_nodes
        return kept
