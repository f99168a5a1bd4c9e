# SPDX-License-Identifier: GPL-3.0-or-later
"""The graph of what needs what in a .blend file, as plain data, and what has to be kept for some of it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple


class Node(NamedTuple):
    """A part of a .blend file that is kept or removed as a whole.

    Attributes:
        datablock: the datablock, as `datablock_key` writes it.
        bone: name of a bone of the armature object `datablock`; empty for the datablock itself.
        driven_path: RNA path of a driven property of `datablock`; empty otherwise.
    """

    datablock: str
    bone: str = ""
    driven_path: str = ""


def datablock_key(id_type: str, name: str, library: str = "") -> str:
    """Return the key of a datablock in `Node.datablock`; names are unique for each type and library."""
    return f"{id_type}/{name}/{library}" if library else f"{id_type}/{name}"


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


def chain_members(parents: Mapping[str, str], owner: str, chain_count: int, use_tail: bool = True) -> list[str]:
    """Return the bones that an IK or Spline IK constraint moves, from its owner up.

    Args:
        parents: name of the parent of each bone; empty for a root.
        owner: name of the bone that has the constraint.
        chain_count: number of bones in the chain; 0 for all up to the root.
        use_tail: whether the chain includes the owner; if not, it begins at the owner's parent. The owner is returned
            in any case, because the chain needs its constraint.
    """
    members, count = [owner], 1 if use_tail else 0
    while (parent := parents[members[-1]]) and (not chain_count or count < chain_count):
        members.append(parent)
        count += 1
    return members
