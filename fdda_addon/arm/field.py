# SPDX-License-Identifier: GPL-3.0-or-later
"""Signed distance fields: lofts and ellipsoids, joined and subtracted with smooth blends.

Every form answers `distance(points)`: (n, 3) float64 points in meters to (n,) float64 meters, negative inside. The
answers are first-order distances: exact in sign, and close to the truth near the surface, which is where they are read.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np


class Solid(Protocol):
    """A solid with a bounding sphere."""

    center: np.ndarray
    reach: float

    def distance(self, points: np.ndarray) -> np.ndarray: ...


def axes_along(axis, up) -> np.ndarray:
    """(3, 3) rows: unit `axis`, the side axis, and `up` made square to `axis`. side = up x axis."""
    a = np.asarray(axis, float)
    a = a / np.linalg.norm(a)
    u = np.asarray(up, float)
    u = u - a * np.dot(a, u)
    u /= np.linalg.norm(u)
    return np.stack([a, np.cross(u, a), u])


def cubic_curve(at: np.ndarray, knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Evaluate a cubic curve through (k,) ascending `knots` and (k, c) `values` at (n,) positions, with constant ends.

    Monotone between knots (slopes after Fritsch and Butland, 1984), so a limb does not bulge where no station says so.
    """
    width = np.diff(knots)[:, None]
    slope = np.diff(values, axis=0) / width
    w1, w2 = 2 * width[1:] + width[:-1], width[1:] + 2 * width[:-1]
    before, after = slope[:-1], slope[1:]
    same = before * after > 0
    harmonic = (w1 + w2) / (w1 / np.where(same, before, 1.0) + w2 / np.where(same, after, 1.0))
    tangent = np.concatenate([slope[:1], np.where(same, harmonic, 0.0), slope[-1:]])
    t = np.clip(at, knots[0], knots[-1])
    i = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 2)
    h = width[i]
    s = ((t - knots[i]) / h[:, 0])[:, None]
    return (
        values[i] * (1 + 2 * s) * (1 - s) ** 2
        + tangent[i] * h * s * (1 - s) ** 2
        + values[i + 1] * s * s * (3 - 2 * s)
        - tangent[i + 1] * h * s * s * (1 - s)
    )


class Ellipsoid:
    """center (3,), radii (3,) along the rows of `axes` (3, 3), meters."""

    def __init__(self, center, radii, axes=None):
        self.center = np.asarray(center, float)
        self.radii = np.asarray(radii, float)
        self.axes = np.eye(3) if axes is None else axes
        self.reach = float(self.radii.max())

    def distance(self, points: np.ndarray) -> np.ndarray:
        local = (points - self.center) @ self.axes.T / self.radii
        k0 = np.sqrt(np.einsum("ij,ij->i", local, local))
        scaled = local / self.radii
        k1 = np.sqrt(np.einsum("ij,ij->i", scaled, scaled))
        return k0 * (k0 - 1.0) / np.maximum(k1, 1e-9)


class HalfSpace:
    """The half-space behind `point` (3,), opposite of the direction `outward` (3,)."""

    def __init__(self, point, outward):
        self.center = np.asarray(point, float)
        self.outward = np.asarray(outward, float)
        self.reach = np.inf

    def distance(self, points: np.ndarray) -> np.ndarray:
        return (points - self.center) @ self.outward


class Loft:
    """A limb: cross-sections along a straight axis, each with its own center and four half-widths.

    origin (3,): where station 0 is. frame: rows along, side, up. stations: (k, 7) float, columns
    along, center side, center up, half-width to +side, -side, +up, -up; meters. caps: how far the rounded ends reach
    in from the first and last station. power: 2 is an ellipse, more is boxier.
    """

    def __init__(self, origin, axes, stations, caps=(0.01, 0.01), power=2.0):
        self.origin = np.asarray(origin, float)
        self.axes = np.asarray(axes, float)
        self.stations = np.asarray(stations, float)
        self.caps = caps
        self.power = power
        first, last = self.stations[0, 0], self.stations[-1, 0]
        self.center = self.origin + self.axes[0] * (first + last) / 2
        self.reach = float((last - first) / 2 + np.abs(self.stations[:, 1:]).max() * 1.5)

    def distance(self, points: np.ndarray) -> np.ndarray:
        local = (points - self.origin) @ self.axes.T
        knots = self.stations[:, 0]
        section = cubic_curve(local[:, 0], knots, self.stations[:, 1:])
        side, up = local[:, 1] - section[:, 0], local[:, 2] - section[:, 1]
        half_side = np.where(side > 0, section[:, 2], section[:, 3])
        half_up = np.where(up > 0, section[:, 4], section[:, 5])
        a, b = np.abs(side) / half_side, np.abs(up) / half_up
        p = self.power
        radial = (a**p + b**p) ** (1.0 / p)
        start, end = knots[0] + self.caps[0], knots[-1] - self.caps[1]
        past = np.maximum(local[:, 0] - end, 0.0) / self.caps[1] + np.maximum(start - local[:, 0], 0.0) / self.caps[0]
        q = np.sqrt(radial**2 + past**2)
        # |grad q| at this place turns the ratio into a length.
        tiny = 1e-9
        da = (a / np.maximum(radial, tiny)) ** (p - 1) / half_side
        db = (b / np.maximum(radial, tiny)) ** (p - 1) / half_up
        slope = np.sqrt(
            (radial / np.maximum(q, tiny)) ** 2 * (da**2 + db**2)
            + (past / np.maximum(q, tiny)) ** 2 / np.where(local[:, 0] > end, self.caps[1], self.caps[0]) ** 2
        )
        return (q - 1.0) / np.maximum(slope, 1.0)


@dataclass(frozen=True)
class Stroke:
    """One solid that is added or subtracted, with a smooth blend of about `blend` meters."""

    form: Solid
    blend: float
    carve: bool = False


def _smooth_minimum(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """Compute the quadratic smooth minimum of two distances."""
    h = np.maximum(k - np.abs(a - b), 0.0) / k
    return np.minimum(a, b) - h * h * k * 0.25


class Field:
    """Signed distance field of strokes in order; the first one must cover all evaluated points."""

    def __init__(self, strokes: list[Stroke]):
        self.strokes = strokes

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Compute the (n,) float64 signed distances of (n, 3) points, meters."""
        return self._distance(points, self._points_near_strokes(points))

    def distance_and_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute (n,) distances in meters and (n, 3) gradients, from differences at a tetrahedron of 0.1 mm."""
        step, near = 1e-4, self._points_near_strokes(points)
        corners = np.array([[1.0, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]])
        values = np.array([self._distance(points + corner * step, near) for corner in corners])
        return values.mean(axis=0), values.T @ corners / (4 * step)

    def _points_near_strokes(self, points: np.ndarray) -> list[np.ndarray]:
        """Return for each stroke the points near its solid."""
        near = []
        for stroke in self.strokes:
            offset = points - stroke.form.center
            limit = stroke.form.reach + stroke.blend + 0.03
            near.append(np.flatnonzero(np.einsum("ij,ij->i", offset, offset) < limit * limit))
        return near

    def _distance(self, points: np.ndarray, near: list[np.ndarray]) -> np.ndarray:
        result = np.full(len(points), 1.0)
        for stroke, index in zip(self.strokes, near, strict=True):
            here, there = result[index], stroke.form.distance(points[index])
            result[index] = (
                -_smooth_minimum(-here, there, stroke.blend)
                if stroke.carve
                else _smooth_minimum(here, there, stroke.blend)
            )
        return result
