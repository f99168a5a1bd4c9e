# SPDX-License-Identifier: GPL-3.0-or-later
"""Normals and edges of small meshes whose errors can be computed by hand."""

import numpy as np
import pytest

from fdda_addon.core.mathematics.partition import Partition
from fdda_addon.core.mathematics.surface import Surface, SurfaceComparison, angles_between, are_faces, surface_errors

from ..limb import make_rig, partitions_of

CUBE_POSITIONS = np.float32([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
CUBE_FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]


def make_surface(*faces: tuple[int, ...]) -> Surface:
    """Return a surface of faces, given by the vertices of their corners."""
    corner_counts = np.array([len(face) for face in faces])
    return Surface((np.cumsum(corner_counts) - corner_counts).astype(np.int32), np.concatenate(faces).astype(np.int32))


def test_normals_and_edges_of_a_cube():
    cube = make_surface(*CUBE_FACES)
    assert cube.vertices.tolist() == list(range(8)) and cube.edges.shape == (12, 2)
    np.testing.assert_allclose(cube.normals(CUBE_POSITIONS), CUBE_POSITIONS / np.sqrt(3), atol=1e-7)
    np.testing.assert_allclose(cube.edge_lengths(CUBE_POSITIONS), 2)


def test_normals_are_weighted_by_the_angle():
    """Vertex 0 has a corner of 90 degrees facing Z, and one of 45 degrees facing Y in a much larger face."""
    positions = np.float32([(0, 0, 0), (1, 0, 0), (0, 1, 0), (10, 0, 10)])
    normals = make_surface((0, 1, 2), (0, 3, 1)).normals(positions)
    expected = np.array([0, 1, 2]) / np.sqrt(5)
    np.testing.assert_allclose(normals[0], expected, atol=1e-7)
    np.testing.assert_allclose(normals[2], (0, 0, 1), atol=1e-7)
    np.testing.assert_allclose(normals[3], (0, 1, 0), atol=1e-7)


def test_a_bent_quad_has_the_normal_of_its_diagonals():
    positions = np.float32([(0, 0, 0), (1, 0, 0.5), (1, 1, 0), (0, 1, 0)])
    expected = np.cross(positions[2] - positions[0], positions[3] - positions[1])
    expected /= np.linalg.norm(expected)
    np.testing.assert_allclose(make_surface((0, 1, 2, 3)).normals(positions), np.tile(expected, (4, 1)), atol=1e-6)


def test_faces_without_area_have_zero_normals():
    surface = make_surface((0, 1, 2))
    positions = np.float32([(0, 0, 0), (1, 1, 1), (2, 2, 2)])
    assert (surface.normals(positions) == 0).all() and (surface.normals(positions * 0) == 0).all()


@pytest.mark.parametrize("degrees", [0, 1e-5, 0.01, 30, 90, 179.999, 180])
def test_angles_between_normals(degrees):
    normals = np.array([(1.0, 0, 0)])
    other_normals = np.array([(np.cos(np.radians(degrees)), 0, np.sin(np.radians(degrees)))])
    assert angles_between(normals, other_normals) == pytest.approx([degrees], rel=1e-6, abs=1e-9)


def test_angles_to_a_zero_normal():
    normals, zero_normals = np.array([(0.0, 1, 0)]), np.zeros((1, 3))
    assert angles_between(normals, zero_normals) == angles_between(zero_normals, normals) == 90
    assert angles_between(zero_normals, zero_normals) == 0


def test_errors_across_borders_and_inside():
    """The vertices of a strip along X have the partitions of the limb, and the strip is scaled along X."""
    rig = make_rig()
    partitions = partitions_of(rig)
    joint_of_vertex = {int(v): p.joint for p in partitions for v in p.vertices}
    strip = make_surface(*((i, i + 1, i + 2) for i in range(38)))
    rest_positions = np.stack([np.arange(40.0) ** 1.1, np.arange(40) % 2, np.zeros(40)], axis=1).astype(np.float32)
    scaled_positions = rest_positions * np.float32([1.25, 1, 1])
    comparison = SurfaceComparison(strip, rest_positions, partitions)
    errors = surface_errors(
        [
            comparison.compare(rest_positions, (scaled_positions,))[0],
            comparison.compare(rest_positions, (rest_positions,))[0],
        ]
    )
    errors_by_crossing, errors_beside = {True: [], False: []}, []
    border_vertices = {
        int(v) for edge in strip.edges for v in edge if joint_of_vertex[edge[0]] != joint_of_vertex[edge[1]]
    }
    for a, b in strip.edges:
        lengths = [np.linalg.norm(p[b].astype(float) - p[a]) for p in (rest_positions, scaled_positions)]
        is_crossing = joint_of_vertex[a] != joint_of_vertex[b]
        errors_by_crossing[is_crossing].append((lengths[1] - lengths[0]) / lengths[0])
        if not is_crossing and border_vertices & {int(a), int(b)}:
            errors_beside.append(errors_by_crossing[False][-1])
    assert min(len(edge_errors) for edge_errors in errors_by_crossing.values()) > 5
    np.testing.assert_allclose(errors.across, [np.mean(errors_by_crossing[True]), 0], rtol=1e-5)
    np.testing.assert_allclose(errors.beside, [np.mean(errors_beside), 0], rtol=1e-5)
    np.testing.assert_allclose(errors.inside, [np.mean(errors_by_crossing[False]), 0], rtol=1e-5)
    edge_statistics = errors.edges_json()
    assert edge_statistics["ratio"] == pytest.approx(
        np.mean(errors_by_crossing[True]) / np.mean(errors_by_crossing[False]), rel=1e-5
    )
    assert errors.angles.shape == (2, 40)
    assert errors.normals_json() == {"mean": 0, "p99": 0, "max": 0}


def test_statistics_of_normal_angles():
    positions = np.float32([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    tilted_positions = np.float32([(0, 0, 0), (1, 0, 1), (0, 1, 0)])
    comparison = SurfaceComparison(make_surface((0, 1, 2)), positions, (Partition(0, (), np.arange(3)),))
    statistics = surface_errors(
        [comparison.compare(positions, (p,))[0] for p in (positions, tilted_positions)]
    ).normals_json()
    assert statistics == {"mean": pytest.approx(22.5), "p99": pytest.approx(45), "max": pytest.approx(45)}


def test_a_single_partition_and_a_zero_length_edge_have_no_error():
    positions = np.float32([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 1, 0)])
    comparison = SurfaceComparison(make_surface((0, 1, 2, 3)), positions, (Partition(0, (), np.arange(4)),))
    statistics = surface_errors(comparison.compare(positions, (positions * 1.5,))).edges_json()
    assert statistics == {"across": None, "beside": None, "inside": pytest.approx(0.5), "ratio": None}


@pytest.mark.parametrize(
    ("starts", "vertices", "is_valid"),
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
def test_invalid_indices_are_no_faces(starts, vertices, is_valid):
    assert are_faces(np.array(starts, np.int32), np.array(vertices, np.int32), 4) is is_valid
