# SPDX-License-Identifier: GPL-3.0-or-later
"""Signed distance fields of solids, which are joined and subtracted with smooth blends.

Every solid has a method `distance(points)`, which returns (n,) float64 signed distances of (n, 3) float64 points, in
meters, negative inside. The distances are first-order approximations: their sign is exact, and their value is accurate
near the surface, where it is used.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np


class Solid(Protocol):
    """A solid with a bounding sphere: `center` (3,) and `bounding_radius`, meters."""

    center: np.ndarray
    bounding_radius: float

    def distance(self, points: np.ndarray) -> np.ndarray: ...


def axes_along(axis, up) -> np.ndarray:
    """Return an orthonormal basis, (3, 3), with rows along `axis`, to the side (up x axis), and up."""
    unit_axis = np.asarray(axis, float)
    unit_axis = unit_axis / np.linalg.norm(unit_axis)
    unit_up = np.asarray(up, float)
    unit_up = unit_up - unit_axis * np.dot(unit_axis, unit_up)
    unit_up /= np.linalg.norm(unit_up)
    return np.stack([unit_axis, np.cross(unit_up, unit_axis), unit_up])


def cubic_curve(positions: np.ndarray, knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Evaluate a cubic curve through (k,) ascending `knots` and (k, c) `values` at (n,) positions, with constant ends.

    The curve is monotone between knots (slopes of Fritsch and Butland, 1984), so a limb has no bulges between stations.
    """
    knot_spacing = np.diff(knots)[:, None]
    slopes = np.diff(values, axis=0) / knot_spacing
    weights_before, weights_after = 2 * knot_spacing[1:] + knot_spacing[:-1], knot_spacing[1:] + 2 * knot_spacing[:-1]
    slopes_before, slopes_after = slopes[:-1], slopes[1:]
    has_same_sign = slopes_before * slopes_after > 0
    harmonic_means = (weights_before + weights_after) / (
        weights_before / np.where(has_same_sign, slopes_before, 1.0)
        + weights_after / np.where(has_same_sign, slopes_after, 1.0)
    )
    tangents = np.concatenate([slopes[:1], np.where(has_same_sign, harmonic_means, 0.0), slopes[-1:]])
    clipped_positions = np.clip(positions, knots[0], knots[-1])
    segments = np.clip(np.searchsorted(knots, clipped_positions, side="right") - 1, 0, len(knots) - 2)
    segment_widths = knot_spacing[segments]
    t = ((clipped_positions - knots[segments]) / segment_widths[:, 0])[:, None]
    return (
        values[segments] * (1 + 2 * t) * (1 - t) ** 2
        + tangents[segments] * segment_widths * t * (1 - t) ** 2
        + values[segments + 1] * t * t * (3 - 2 * t)
        - tangents[segments + 1] * segment_widths * t * t * (1 - t)
    )


class Ellipsoid:
    """Ellipsoid with center (3,), and radii (3,) along the rows of `axes` (3, 3), meters."""

    def __init__(self, center, radii, axes=None):
        self.center = np.asarray(center, float)
        self.radii = np.asarray(radii, float)
        self.axes = np.eye(3) if axes is None else axes
        self.bounding_radius = float(self.radii.max())

    def distance(self, points: np.ndarray) -> np.ndarray:
        local = (points - self.center) @ self.axes.T / self.radii
        k0 = np.sqrt(np.einsum("ij,ij->i", local, local))
        scaled = local / self.radii
        k1 = np.sqrt(np.einsum("ij,ij->i", scaled, scaled))
        return k0 * (k0 - 1.0) / np.maximum(k1, 1e-9)


class HalfSpace:
    """The half-space behind a plane through `point` (3,) with the outward normal `outward` (3,)."""

    def __init__(self, point, outward):
        self.center = np.asarray(point, float)
        self.outward = np.asarray(outward, float)
        self.bounding_radius = np.inf

    def distance(self, points: np.ndarray) -> np.ndarray:
        return (points - self.center) @ self.outward


class Loft:
    """A limb: cross-sections along a straight axis, each with its own center and four half-widths.

    Attributes:
        origin: (3,) point from which positions along the axis are measured.
        axes: (3, 3) rows: direction along the axis, side, up.
        stations: (k, 7) float, meters. Columns: position along the axis, center to the side, center up, half-widths
            to +side, -side, +up, -up.
        caps: lengths of the rounded ends at the first and last station, meters.
        power: exponent of the cross-section; 2 for an ellipse, a larger exponent for a boxier shape.
    """

    def __init__(self, origin, axes, stations, caps=(0.01, 0.01), power=2.0):
        self.origin = np.asarray(origin, float)
        self.axes = np.asarray(axes, float)
        self.stations = np.asarray(stations, float)
        self.caps = caps
        self.power = power
        first_position, last_position = self.stations[0, 0], self.stations[-1, 0]
        self.center = self.origin + self.axes[0] * (first_position + last_position) / 2
        self.bounding_radius = float((last_position - first_position) / 2 + np.abs(self.stations[:, 1:]).max() * 1.5)

    def distance(self, points: np.ndarray) -> np.ndarray:
        local_points = (points - self.origin) @ self.axes.T
        knots = self.stations[:, 0]
        section = cubic_curve(local_points[:, 0], knots, self.stations[:, 1:])
        side, up = local_points[:, 1] - section[:, 0], local_points[:, 2] - section[:, 1]
        half_side = np.where(side > 0, section[:, 2], section[:, 3])
        half_up = np.where(up > 0, section[:, 4], section[:, 5])
        side_ratio, up_ratio = np.abs(side) / half_side, np.abs(up) / half_up
        power = self.power
        radial_ratio = (side_ratio**power + up_ratio**power) ** (1.0 / power)
        cap_start, cap_end = knots[0] + self.caps[0], knots[-1] - self.caps[1]
        cap_ratio = (
            np.maximum(local_points[:, 0] - cap_end, 0.0) / self.caps[1]
            + np.maximum(cap_start - local_points[:, 0], 0.0) / self.caps[0]
        )
        level = np.sqrt(radial_ratio**2 + cap_ratio**2)
        # Dividing by the length of the gradient converts the level, which has no unit, to a distance.
        epsilon = 1e-9
        side_derivative = (side_ratio / np.maximum(radial_ratio, epsilon)) ** (power - 1) / half_side
        up_derivative = (up_ratio / np.maximum(radial_ratio, epsilon)) ** (power - 1) / half_up
        gradient_length = np.sqrt(
            (radial_ratio / np.maximum(level, epsilon)) ** 2 * (side_derivative**2 + up_derivative**2)
            + (cap_ratio / np.maximum(level, epsilon)) ** 2
            / np.where(local_points[:, 0] > cap_end, self.caps[1], self.caps[0]) ** 2
        )
        return (level - 1.0) / np.maximum(gradient_length, 1.0)


@dataclass(frozen=True)
class Stroke:
    """A solid that is added to a field or subtracted from it, with a smooth blend of about `blend` meters."""

    solid: Solid
    blend: float
    is_subtracted: bool = False


def _smooth_minimum(first_distances: np.ndarray, second_distances: np.ndarray, blend: float) -> np.ndarray:
    """Compute the quadratic smooth minimum of two distances."""
    overlap = np.maximum(blend - np.abs(first_distances - second_distances), 0.0) / blend
    return np.minimum(first_distances, second_distances) - overlap * overlap * blend * 0.25


class Field:
    """Signed distance field that applies strokes in their order. The first stroke must be near all evaluated points."""

    def __init__(self, strokes: list[Stroke]):
        self.strokes = strokes

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Compute the (n,) float64 signed distances of (n, 3) points, meters."""
        return self._distance(points, self._points_near_strokes(points))

    def distance_and_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute (n,) distances in meters and (n, 3) gradients, by finite differences in a tetrahedron of 0.1 mm."""
        step, near_indices = 1e-4, self._points_near_strokes(points)
        corners = np.array([[1.0, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]])
        values = np.array([self._distance(points + corner * step, near_indices) for corner in corners])
        return values.mean(axis=0), values.T @ corners / (4 * step)

    def _points_near_strokes(self, points: np.ndarray) -> list[np.ndarray]:
        """Return for each stroke the indices of the points near its solid."""
        near_indices = []
        for stroke in self.strokes:
            offset = points - stroke.solid.center
            max_distance = stroke.solid.bounding_radius + stroke.blend + 0.03
            near_indices.append(np.flatnonzero(np.einsum("ij,ij->i", offset, offset) < max_distance * max_distance))
        return near_indices

    def _distance(self, points: np.ndarray, near_indices: list[np.ndarray]) -> np.ndarray:
        distances = np.full(len(points), 1.0)
        for stroke, indices in zip(self.strokes, near_indices, strict=True):
            field_distances, solid_distances = distances[indices], stroke.solid.distance(points[indices])
            distances[indices] = (
                -_smooth_minimum(-field_distances, solid_distances, stroke.blend)
                if stroke.is_subtracted
                else _smooth_minimum(field_distances, solid_distances, stroke.blend)
            )
        return distances
