# SPDX-License-Identifier: GPL-3.0-or-later
"""Normals and edges of small meshes whose figures can be worked out by hand."""

import numpy as np
import pytest

from fdda_addon.core.partition import Partition
from fdda_addon.core.surface import Surface, SurfaceComparison, angles_between, are_faces, surface_errors

from .limb import make_rig, partitions_of

CUBE = np.float32([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
CUBE_FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def surface(*faces: tuple[int, ...]) -> Surface:
    counts = np.array([len(face) for face in faces])
    return Surface((np.cumsum(counts) - counts).astype(np.int32), np.concatenate(faces).astype(np.int32))


def test_a_cube():
    cube = surface(*CUBE_FACES)
    assert cube.vertices.tolist() == list(range(8)) and cube.edges.shape == (12, 2)
    np.testing.assert_allclose(cube.normals(CUBE), CUBE / np.sqrt(3), atol=1e-7)
    np.testing.assert_allclose(cube.edge_lengths(CUBE), 2)


def test_far_from_the_origin_nothing_changes():
    turned = surface(*CUBE_FACES).normals(CUBE.astype(np.float64) + 1e6)
    np.testing.assert_allclose(turned, CUBE / np.sqrt(3), atol=1e-7)


def test_normals_are_weighted_by_the_angle():
    """Vertex 0 has a corner of 90 degrees facing z and one of 45 degrees facing y, of a much larger face."""
    positions = np.float32([(0, 0, 0), (1, 0, 0), (0, 1, 0), (10, 0, 10)])
    found = surface((0, 1, 2), (0, 3, 1)).normals(positions)
    expected = np.array([0, 1, 2]) / np.sqrt(5)
    np.testing.assert_allclose(found[0], expected, atol=1e-7)
    np.testing.assert_allclose(found[2], (0, 0, 1), atol=1e-7)
    np.testing.assert_allclose(found[3], (0, 1, 0), atol=1e-7)


def test_a_bent_quad_has_the_normal_of_its_diagonals():
    positions = np.float32([(0, 0, 0), (1, 0, 0.5), (1, 1, 0), (0, 1, 0)])
    expected = np.cross(positions[2] - positions[0], positions[3] - positions[1])
    expected /= np.linalg.norm(expected)
    np.testing.assert_allclose(surface((0, 1, 2, 3)).normals(positions), np.tile(expected, (4, 1)), atol=1e-6)


def test_a_concave_pentagon_faces_as_a_whole_and_not_as_its_dent():
    positions = np.float32([(0, 0, 0), (2, 0, 0), (2, 2, 0), (1, 0.2, 0), (0, 2, 0)])
    np.testing.assert_allclose(surface((0, 1, 2, 3, 4)).normals(positions), [(0, 0, 1)] * 5, atol=1e-7)


def test_vertices_without_faces_have_no_normal_and_edges_are_found_once():
    found = surface((5, 2, 7), (7, 2, 9))
    assert found.vertices.tolist() == [2, 5, 7, 9]
    assert found.edges.tolist() == [[2, 5], [2, 7], [2, 9], [5, 7], [7, 9]]
    assert found.normals(np.random.default_rng(0).normal(size=(12, 3))).shape == (4, 3)


def test_faces_without_area_give_numbers():
    flat = surface((0, 1, 2))
    positions = np.float32([(0, 0, 0), (1, 1, 1), (2, 2, 2)])
    assert (flat.normals(positions) == 0).all() and (flat.normals(positions * 0) == 0).all()


@pytest.mark.parametrize("degrees", [0, 1e-5, 0.01, 30, 90, 179.999, 180])
def test_angles(degrees):
    first = np.array([(1.0, 0, 0)])
    second = np.array([(np.cos(np.radians(degrees)), 0, np.sin(np.radians(degrees)))])
    assert angles_between(first, second) == pytest.approx([degrees], rel=1e-6, abs=1e-9)


def test_angles_to_a_normal_that_is_lost():
    one, none = np.array([(0.0, 1, 0)]), np.zeros((1, 3))
    assert angles_between(one, none) == angles_between(none, one) == 90
    assert angles_between(none, none) == 0


def test_errors_across_borders_and_inside():
    """A strip along x; the limb's partitions are given to its vertices, and every vertex is moved along x."""
    rig = make_rig()
    partitions = partitions_of(rig)
    of_vertex = {int(v): p.joint for p in partitions for v in p.vertices}
    strip = surface(*((i, i + 1, i + 2) for i in range(38)))
    rest = np.stack([np.arange(40.0) ** 1.1, np.arange(40) % 2, np.zeros(40)], axis=1).astype(np.float32)
    other = rest * np.float32([1.25, 1, 1])
    comparison = SurfaceComparison(strip, rest, partitions)
    errors = surface_errors([comparison.compare(rest, (other,))[0], comparison.compare(rest, (rest,))[0]])
    parts, beside = {True: [], False: []}, []
    at_border = {int(v) for edge in strip.edges for v in edge if of_vertex[edge[0]] != of_vertex[edge[1]]}
    for a, b in strip.edges:
        lengths = [np.linalg.norm(p[b].astype(float) - p[a]) for p in (rest, other)]
        crosses = of_vertex[a] != of_vertex[b]
        parts[crosses].append((lengths[1] - lengths[0]) / lengths[0])
        if not crosses and at_border & {int(a), int(b)}:
            beside.append(parts[False][-1])
    assert min(len(part) for part in parts.values()) > 5
    np.testing.assert_allclose(errors.across, [np.mean(parts[True]), 0], rtol=1e-5)
    np.testing.assert_allclose(errors.beside, [np.mean(beside), 0], rtol=1e-5)
    np.testing.assert_allclose(errors.inside, [np.mean(parts[False]), 0], rtol=1e-5)
    found = errors.edges_json()
    assert found["ratio"] == pytest.approx(np.mean(parts[True]) / np.mean(parts[False]), rel=1e-5)
    assert errors.angles.shape == (2, 40)
    assert errors.normals_json() == {"mean": 0, "p99": 0, "max": 0}


def test_figures_of_normals():
    positions = np.float32([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    tilted = np.float32([(0, 0, 0), (1, 0, 1), (0, 1, 0)])
    comparison = SurfaceComparison(surface((0, 1, 2)), positions, (Partition(0, (), np.arange(3)),))
    found = surface_errors([comparison.compare(positions, (p,))[0] for p in (positions, tilted)]).normals_json()
    assert found == {"mean": pytest.approx(22.5), "p99": pytest.approx(45), "max": pytest.approx(45)}


def test_one_partition_has_no_borders_and_an_edge_of_no_length_no_error():
    positions = np.float32([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 1, 0)])
    comparison = SurfaceComparison(surface((0, 1, 2, 3)), positions, (Partition(0, (), np.arange(4)),))
    found = surface_errors(comparison.compare(positions, (positions * 1.5,))).edges_json()
    assert found == {"across": None, "beside": None, "inside": pytest.approx(0.5), "ratio": None}


@pytest.mark.parametrize(
    ("starts", "vertices", "good"),
    [
        ([], [], True),
        ([], [1], False),
        ([0], [0, 1, 2], True),
        ([0, 3], [0, 1, 2, 2, 1, 3], True),
        ([0, 3], [0, 1, 2, 2, 1], False),
        ([1], [0, 1, 2, 3], False),
        ([0], [0, 1, 4], False),
        ([0], [0, 1, -1], False),
        ([0, -(1 << 31)], [0, 1, 2, 3, 0, 1], False),
        ([0, 3, 1 << 30], [0, 1, 2, 3, 0, 1], False),
    ],
)
def test_what_are_faces(starts, vertices, good):
    assert are_faces(np.array(starts, np.int32), np.array(vertices, np.int32), 4) is good
