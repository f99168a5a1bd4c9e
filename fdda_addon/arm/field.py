# SPDX-License-Identifier: GPL-3.0-or-later
"""A surface as the zero level of a field: lofts and ellipsoids, joined and carved smoothly.

Every form answers `distance(points)`: (n, 3) float64 points in metres to (n,) float64 metres, negative inside. The
answers are first-order distances: exact in sign, and close to the truth near the surface, which is where they are read.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np


class Form(Protocol):
    """A solid with a bounding sphere."""

    center: np.ndarray
    reach: float

    def distance(self, points: np.ndarray) -> np.ndarray: ...


def frame_along(axis, up) -> np.ndarray:
    """(3, 3) rows: unit `axis`, the side axis, and `up` made square to `axis`. side = up x axis."""
    a = np.asarray(axis, float)
    a = a / np.linalg.norm(a)
    u = np.asarray(up, float)
    u = u - a * np.dot(a, u)
    u /= np.linalg.norm(u)
    return np.stack([a, np.cross(u, a), u])


def smooth_curve(at: np.ndarray, knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Cubic through (k,) rising `knots` and (k, c) `values`, read at (n,) places, held constant past the ends.

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
    """center (3,), radii (3,) along the rows of `frame` (3, 3), metres."""

    def __init__(self, center, radii, frame=None):
        self.center = np.asarray(center, float)
        self.radii = np.asarray(radii, float)
        self.frame = np.eye(3) if frame is None else frame
        self.reach = float(self.radii.max())

    def distance(self, points: np.ndarray) -> np.ndarray:
        local = (points - self.center) @ self.frame.T / self.radii
        k0 = np.sqrt(np.einsum("ij,ij->i", local, local))
        scaled = local / self.radii
        k1 = np.sqrt(np.einsum("ij,ij->i", scaled, scaled))
        return k0 * (k0 - 1.0) / np.maximum(k1, 1e-9)


class HalfSpace:
    """Everything on the side of `point` (3,) that `outward` (3,) looks away from."""

    def __init__(self, point, outward):
        self.center = np.asarray(point, float)
        self.outward = np.asarray(outward, float)
        self.reach = np.inf

    def distance(self, points: np.ndarray) -> np.ndarray:
        return (points - self.center) @ self.outward


class Loft:
    """A limb: cross-sections along a straight axis, each with its own center and four half-widths.

    origin (3,): where station 0 is. frame: rows along, side, up. stations: (k, 7) float, columns
    along, center side, center up, half-width to +side, -side, +up, -up; metres. caps: how far the rounded ends reach
    in from the first and last station. power: 2 is an ellipse, more is boxier.
    """

    def __init__(self, origin, frame, stations, caps=(0.01, 0.01), power=2.0):
        self.origin = np.asarray(origin, float)
        self.frame = np.asarray(frame, float)
        self.stations = np.asarray(stations, float)
        self.caps = caps
        self.power = power
        first, last = self.stations[0, 0], self.stations[-1, 0]
        self.center = self.origin + self.frame[0] * (first + last) / 2
        self.reach = float((last - first) / 2 + np.abs(self.stations[:, 1:]).max() * 1.5)

    def distance(self, points: np.ndarray) -> np.ndarray:
        local = (points - self.origin) @ self.frame.T
        knots = self.stations[:, 0]
        section = smooth_curve(local[:, 0], knots, self.stations[:, 1:])
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
    """One form added to what is there (or cut out of it), with a fillet of about `blend` metres."""

    form: Form
    blend: float
    carve: bool = False


def _merged(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """Smooth minimum (quadratic) of two distances."""
    h = np.maximum(k - np.abs(a - b), 0.0) / k
    return np.minimum(a, b) - h * h * k * 0.25


class Field:
    """Strokes laid one after the other. The first must reach everything that is asked."""

    def __init__(self, strokes: list[Stroke]):
        self.strokes = strokes

    def distance(self, points: np.ndarray) -> np.ndarray:
        """(n,) float64 metres for (n, 3) points."""
        return self._distance(points, self._near(points))

    def distance_and_gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n,) metres and (n, 3) gradient, by differences along the corners of a tetrahedron of 0.1 mm."""
        step, near = 1e-4, self._near(points)
        corners = np.array([[1.0, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]])
        values = np.array([self._distance(points + corner * step, near) for corner in corners])
        return values.mean(axis=0), values.T @ corners / (4 * step)

    def _near(self, points: np.ndarray) -> list[np.ndarray]:
        """For each stroke, the points that it may matter to: those near its form."""
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
            result[index] = -_merged(-here, there, stroke.blend) if stroke.carve else _merged(here, there, stroke.blend)
        return result
