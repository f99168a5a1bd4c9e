# SPDX-License-Identifier: GPL-3.0-or-later
"""The contracted biceps as offsets from the rest positions."""

import numpy as np

# Meters by density: how high the key stands over the relaxed arm. Corrective Smooth comes after it and takes its share,
# the more the coarser the quads; about 17 mm are left at any density.
PEAK = {1: 0.036, 2: 0.028, 3: 0.022}


def _bump(x: np.ndarray, top: float, rise: float, fall: float) -> np.ndarray:
    """Evaluate a bell curve: 1 at `top`, with half-width `rise` before it and `fall` after it."""
    s = (x - top) / np.where(x < top, rise, fall)
    return np.exp(-0.5 * s * s)


def biceps_offsets(points: np.ndarray, normals: np.ndarray, peak: float) -> np.ndarray:
    """Compute (n, 3) offsets in meters from (n, 3) rest `points` with unit outward `normals`, in arm space.

    The muscle shortens: it peaks past the middle of the upper arm, at `peak` meters, falls off steeply towards the
    elbow into its tendon, thins out at both ends, and a furrow parts its two heads. The triceps opposite is drawn flat.
    """
    # Contiguous, or the last bit of an angle hangs on where memory lies: past a strided array's end NumPy may see
    # another, and then leaves its vector code (two machines' arms would differ, and two builds on one).
    x, y, z = np.ascontiguousarray(points.T)
    angle = np.arctan2(z, -y)  # 0 at the crease side, positive to the back of the hand
    long_head = _bump(x, 0.166, 0.045, 0.040) * np.exp(-0.5 * ((angle - 0.34) / 0.42) ** 2)
    short_head = 0.95 * _bump(x, 0.178, 0.048, 0.036) * np.exp(-0.5 * ((angle + 0.38) / 0.42) ** 2)
    belly = np.maximum(long_head, short_head) + 0.20 * np.minimum(long_head, short_head)
    furrow = 0.30 * _bump(x, 0.172, 0.050, 0.040) * np.exp(-0.5 * ((angle + 0.02) / 0.13) ** 2)
    ends = 0.14 * _bump(x, 0.256, 0.018, 0.020) + 0.10 * _bump(x, 0.075, 0.022, 0.022)
    ends *= np.exp(-0.5 * (angle / 0.7) ** 2)
    back = np.abs(np.arctan2(z, y))
    flat = 0.10 * _bump(x, 0.150, 0.060, 0.050) * np.exp(-0.5 * (back / 0.7) ** 2)
    height = belly - furrow - ends - flat
    height[np.abs(height) < 1e-3] = 0.0
    # Muscle lifts to the front more than along the skin.
    lift = normals + np.array([0.0, -0.4, 0.0]) * (belly > 0)[:, None]
    lift /= np.linalg.norm(lift, axis=1, keepdims=True)
    return lift * (height * peak / height.max())[:, None]
