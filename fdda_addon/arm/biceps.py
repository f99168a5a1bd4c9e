# SPDX-License-Identifier: GPL-3.0-or-later
"""Computes the shape key of the contracted biceps, as offsets from the rest positions."""

import numpy as np

# Height of the shape key over the relaxed arm, meters, by density. Corrective Smooth comes after the key and flattens
# it, more strongly on coarser quads, so that about 17 mm remain at any density.
PEAK_HEIGHTS = {1: 0.036, 2: 0.028, 3: 0.022}


def _bell_curve(x: np.ndarray, center: float, width_before: float, width_after: float) -> np.ndarray:
    """Evaluate a bell curve that is 1 at its center, with different widths before and after the center."""
    distance_ratio = (x - center) / np.where(x < center, width_before, width_after)
    return np.exp(-0.5 * distance_ratio * distance_ratio)


def biceps_offsets(points: np.ndarray, normals: np.ndarray, peak: float) -> np.ndarray:
    """Compute (n, 3) offsets in meters from (n, 3) rest `points` with unit outward `normals`, in arm space.

    The contracted muscle is highest past the middle of the upper arm, at `peak` meters. It falls off steeply to its
    tendon at the elbow, is thin at both ends, and has a furrow between its two heads. The triceps opposite becomes
    flatter.
    """
    # The arrays must be contiguous. NumPy does not always use vector instructions for strided arrays, so the last bit
    # of an angle would differ between machines, and between two builds on one machine.
    x, y, z = np.ascontiguousarray(points.T)
    angle = np.arctan2(z, -y)  # 0 on the side of the elbow crease, positive towards the back of the hand
    long_head = _bell_curve(x, 0.166, 0.045, 0.040) * np.exp(-0.5 * ((angle - 0.34) / 0.42) ** 2)
    short_head = 0.95 * _bell_curve(x, 0.178, 0.048, 0.036) * np.exp(-0.5 * ((angle + 0.38) / 0.42) ** 2)
    belly = np.maximum(long_head, short_head) + 0.20 * np.minimum(long_head, short_head)
    furrow = 0.30 * _bell_curve(x, 0.172, 0.050, 0.040) * np.exp(-0.5 * ((angle + 0.02) / 0.13) ** 2)
    thin_ends = 0.14 * _bell_curve(x, 0.256, 0.018, 0.020) + 0.10 * _bell_curve(x, 0.075, 0.022, 0.022)
    thin_ends *= np.exp(-0.5 * (angle / 0.7) ** 2)
    triceps_angle = np.abs(np.arctan2(z, y))
    triceps_flattening = 0.10 * _bell_curve(x, 0.150, 0.060, 0.050) * np.exp(-0.5 * (triceps_angle / 0.7) ** 2)
    heights = belly - furrow - thin_ends - triceps_flattening
    heights[np.abs(heights) < 1e-3] = 0.0
    # The muscle rises towards the front more than along the normals of the skin.
    directions = normals + np.array([0.0, -0.4, 0.0]) * (belly > 0)[:, None]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * (heights * peak / heights.max())[:, None]
