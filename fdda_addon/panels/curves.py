# SPDX-License-Identifier: GPL-3.0-or-later
"""The curves of a training, drawn into a panel as a preview that lives in memory alone."""

from typing import TYPE_CHECKING

import bpy

if TYPE_CHECKING:  # Blender starts without numpy.
    import numpy as np

WIDTH, HEIGHT = 192, 192
LINE = 1.6
"""Half the width of a line, pixels."""
LEGEND = {
    "training": ("Training", "COLORSET_04_VEC", (0.25, 0.55, 1.0)),
    "validation": ("Validation", "COLORSET_02_VEC", (1.0, 0.55, 0.2)),
}
BACKGROUND, GRID = (0.10, 0.10, 0.10, 1.0), (0.20, 0.20, 0.20, 1.0)

_previews: object = None
_drawn: tuple = ()


def draw(layout: bpy.types.UILayout, curves: dict[str, list[float]]) -> None:
    """Draw curves of an error by epoch, on a logarithmic scale, with a legend; nothing before there are two points."""
    lengths = [len(curves.get(name, ())) for name in LEGEND]
    if min(lengths) < 2:
        return
    layout.template_icon(icon_value=_icon(curves), scale=9)
    column = layout.column(align=True)
    for name, (label, icon, _) in LEGEND.items():
        column.label(text=f"{label}: {curves[name][-1]:.3f} mm", icon=icon)


def _icon(curves: dict[str, list[float]]) -> int:
    """Icon of the picture of the curves; it is painted again when they have grown."""
    import bpy.utils.previews

    global _previews, _drawn
    if _previews is None:
        _previews = bpy.utils.previews.new()
        _previews.new("curves").image_size = (WIDTH, HEIGHT)
    key = (id(curves), *(len(curve) for curve in curves.values()))
    preview = _previews["curves"]
    if key != _drawn:
        _drawn = key
        preview.image_pixels_float.foreach_set(paint(curves).ravel())
    return preview.icon_id


def paint(curves: "dict[str, list[float]]") -> "np.ndarray":
    """(HEIGHT, WIDTH, 4) float32, rows from the bottom: the curves in their colours, a line a decade."""
    import numpy as np

    pixels = np.empty((HEIGHT, WIDTH, 4), np.float32)
    pixels[:] = BACKGROUND
    logs = {name: np.log10(np.maximum(curves[name], 1e-6)) for name in LEGEND}
    low, high = min(log.min() for log in logs.values()), max(log.max() for log in logs.values())
    margin = max(0.05 * (high - low), 0.02)
    low, high = low - margin, high + margin

    def place(log: "np.ndarray | float") -> "np.ndarray | float":
        return (log - low) / (high - low) * (HEIGHT - 1)

    for decade in range(int(np.ceil(low)), int(np.floor(high)) + 1):
        pixels[round(place(decade))] = GRID
    rows = np.arange(HEIGHT)[:, None]
    for name, (_, _, colour) in LEGEND.items():
        columns = np.linspace(0, len(logs[name]) - 1, WIDTH)
        heights = place(np.interp(columns, np.arange(len(logs[name])), logs[name]))
        after = np.append(heights[1:], heights[-1])
        bottom, top = np.minimum(heights, after) - LINE, np.maximum(heights, after) + LINE
        # Soft edges, half a pixel to either side.
        cover = np.clip(np.minimum(rows - bottom, top - rows) + 0.5, 0, 1)[..., None]
        pixels[..., :3] += cover * (np.float32(colour) - pixels[..., :3])
    return pixels


def release() -> None:
    """Free the picture."""
    global _previews, _drawn
    if _previews is not None:
        bpy.utils.previews.remove(_previews)
        _previews, _drawn = None, ()
