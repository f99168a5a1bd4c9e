# SPDX-License-Identifier: GPL-3.0-or-later
"""What a fast rig keeps follows from the graph of what needs what."""

import pytest

from fdda_addon.rig.references import DependencyGraph, Node

RIG = "rig"
PARENTS = {"hips": "", "thigh": "hips", "shin": "thigh", "foot": "shin", "toe": "foot"}


def bone(name: str) -> Node:
    return Node(RIG, bone=name)


def test_a_node_keeps_what_it_needs_directly_and_through_others():
    graph = DependencyGraph()
    graph.add(bone("hand"), bone("forearm"), bone("target"))
    graph.add(bone("forearm"), bone("shoulder"))
    graph.add(bone("finger"), bone("hand"))
    assert graph.kept([bone("hand")]) == {bone("hand"), bone("forearm"), bone("target"), bone("shoulder")}


def test_nodes_that_need_each_other_are_kept_together():
    graph = DependencyGraph()
    graph.add(bone("a"), bone("b"))
    graph.add(bone("b"), bone("a"))
    assert graph.kept([bone("b")]) == {bone("a"), bone("b")}


@pytest.mark.parametrize("member", ["foot", "shin", "thigh"])
def test_each_bone_of_a_chain_keeps_the_owner_and_its_target(member):
    """A bone in an IK chain depends on the bone below it that has the constraint."""
    graph = DependencyGraph()
    for name, parent in PARENTS.items():
        graph.add(bone(name), *([bone(parent)] if parent else []))
    graph.add(bone("foot"), bone("ik_target"))
    graph.add_chain(map(bone, ("foot", "shin", "thigh")))
    kept = graph.kept([bone(member)])
    assert kept == {bone(name) for name in ("foot", "shin", "thigh", "hips", "ik_target")}
    assert bone("ik_target") not in graph.kept([bone("hips")])
