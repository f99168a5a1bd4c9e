# SPDX-License-Identifier: GPL-3.0-or-later
"""The biceps at full contraction, as offsets from the rest shape."""

import numpy as np

# Metres: how high the bulge stands over the relaxed arm, before it is scaled to exactly this.
PEAK = 0.022


def _bump(x: np.ndarray, top: float, rise: float, fall: float) -> np.ndarray:
    """1 at `top`, a bell of half-width `rise` before it and `fall` after it."""
    s = (x - top) / np.where(x < top, rise, fall)
    return np.exp(-0.5 * s * s)


def biceps_offsets(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n, 3) offsets in metres from rest `points` (n, 3), with unit outward `normals` (n, 3), in arm space.

    The muscle shortens: it peaks half way down the upper arm, falls off steeply towards the elbow into its tendon, thins
    out at both ends, and a shallow furrow parts its two heads. The triceps opposite is drawn flat.
    """
    x = points[:, 0]
    angle = np.arctan2(points[:, 2], -points[:, 1])  # 0 at the crease side, positive to the back of the hand
    long_head = _bump(x, 0.168, 0.044, 0.036) * np.exp(-0.5 * ((angle - 0.36) / 0.40) ** 2)
    short_head = 0.92 * _bump(x, 0.178, 0.046, 0.034) * np.exp(-0.5 * ((angle + 0.42) / 0.40) ** 2)
    belly = np.maximum(long_head, short_head) + 0.25 * np.minimum(long_head, short_head)
    furrow = 0.30 * _bump(x, 0.165, 0.055, 0.045) * np.exp(-0.5 * ((angle + 0.03) / 0.15) ** 2)
    ends = 0.10 * (_bump(x, 0.252, 0.016, 0.020) + 0.7 * _bump(x, 0.080, 0.022, 0.020))
    ends *= np.exp(-0.5 * (angle / 0.7) ** 2)
    back = np.abs(np.arctan2(points[:, 2], points[:, 1]))
    flat = 0.10 * _bump(x, 0.150, 0.060, 0.050) * np.exp(-0.5 * (back / 0.7) ** 2)
    height = belly - furrow - ends - flat
    height[np.abs(height) < 1e-3] = 0.0
    # Muscle lifts to the front more than along the skin.
    lift = normals + np.array([0.0, -0.6, 0.0]) * (belly > 0)[:, None]
    lift /= np.linalg.norm(lift, axis=1, keepdims=True)
    return lift * (height * PEAK / height.max())[:, None]
