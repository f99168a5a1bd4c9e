# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the error curves of a training into a panel, as a preview image in memory."""

import math
from typing import TYPE_CHECKING

import bpy

if TYPE_CHECKING:  # Blender starts without numpy.
    import numpy as np

WIDTH, HEIGHT = 224, 224
MARGIN_LEFT, MARGIN_BOTTOM = 34, 16
"""Space for the numbers of the axes, pixels."""
LINE_HALF_WIDTH = 1.6
"""Half the width of a line, pixels."""
LEGEND = {
    "training": ("Seen Poses", "COLORSET_04_VEC", (0.25, 0.55, 1.0)),
    "validation": ("Unseen Poses", "COLORSET_02_VEC", (1.0, 0.55, 0.2)),
}
BACKGROUND_COLOR, GRID_COLOR = (0.10, 0.10, 0.10, 1.0), (0.20, 0.20, 0.20, 1.0)
TEXT_COLOR = (0.75, 0.75, 0.75)
TICK_STEPS = (1, 2, 5)
"""Errors with a grid line and a number in each decade."""
DIGIT_GLYPHS = {
    "0": "757555557", "1": "262222227", "2": "711744447", "3": "711711117", "4": "555711111", "5": "744711117",
    "6": "744755557", "7": "711111111", "8": "757557557", "9": "757711117", ".": "000000002",
}  # fmt: skip
"""Glyphs of 3 by 9 pixels. Each digit of a string is a row of 3 bits."""

_previews: object = None
_drawn_key: tuple = ()


def draw(layout: bpy.types.UILayout, curves: dict[str, list[float]]) -> None:
    """Draw error curves by epoch on a logarithmic scale, with a legend. Draw nothing before the second epoch."""
    lengths = [len(curves.get(name, ())) for name in LEGEND]
    if min(lengths) < 2:
        return
    layout.label(text="Error (mm) per Pass")
    layout.template_icon(icon_value=_icon(curves), scale=9)
    column = layout.column(align=True)
    for name, (label, icon, _) in LEGEND.items():
        column.label(text=f"{label}: {curves[name][-1]:.3f} mm", icon=icon)


def _icon(curves: dict[str, list[float]]) -> int:
    """Return the icon of the curves. Paint it again when they have grown."""
    import bpy.utils.previews

    from ..scene.arrays import write_pixels

    global _previews, _drawn_key
    if _previews is None:
        _previews = bpy.utils.previews.new()
        _previews.new("curves").image_size = (WIDTH, HEIGHT)
    key = (id(curves), *(len(curve) for curve in curves.values()))
    preview = _previews["curves"]
    if key != _drawn_key:
        _drawn_key = key
        write_pixels(preview, paint(curves))
    return preview.icon_id


def paint(curves: "dict[str, list[float]]") -> "np.ndarray":
    """Return an image of the curves with axes: (HEIGHT, WIDTH, 4) float32 RGBA, rows from the bottom."""
    import numpy as np

    pixels = np.empty((HEIGHT, WIDTH, 4), np.float32)
    pixels[:] = BACKGROUND_COLOR
    logs = {name: np.log10(np.maximum(curves[name], 1e-6)) for name in LEGEND}
    low, high = min(log.min() for log in logs.values()), max(log.max() for log in logs.values())
    margin = max(0.05 * (high - low), 0.02)
    low, high = low - margin, high + margin
    inside = pixels[MARGIN_BOTTOM:, MARGIN_LEFT:]
    height, width = inside.shape[:2]

    def to_row(log: "np.ndarray | float") -> "np.ndarray | float":
        return (log - low) / (high - low) * (height - 1)

    _paint_grid(pixels, {error: round(to_row(float(np.log10(error)))) for error in _tick_errors(10**low, 10**high)})
    count = len(logs["training"])
    _paint_number(pixels, "1", MARGIN_LEFT, 3)
    _paint_number(pixels, str(count), WIDTH - 8 * len(str(count)), 3)
    rows = np.arange(height)[:, None]
    for name, (_, _, color) in LEGEND.items():
        columns = np.linspace(0, count - 1, width)
        heights = to_row(np.interp(columns, np.arange(count), logs[name]))
        after = np.append(heights[1:], heights[-1])
        bottom, top = np.minimum(heights, after) - LINE_HALF_WIDTH, np.maximum(heights, after) + LINE_HALF_WIDTH
        # Soft edges, half a pixel to either side.
        cover = np.clip(np.minimum(rows - bottom, top - rows) + 0.5, 0, 1)[..., None]
        inside[..., :3] += cover * (np.float32(color) - inside[..., :3])
    return pixels


def _tick_errors(low: float, high: float) -> list[float]:
    """Return the round errors from `low` to `high` that get a grid line, mm; usually at least one."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    marks = [mark * 10.0**decade for decade in decades for mark in TICK_STEPS if low <= mark * 10.0**decade <= high]
    decadic = [mark for mark in marks if round(math.log10(mark), 6) % 1 == 0]
    return decadic if len(decadic) > 2 else marks


def _paint_grid(pixels: "np.ndarray", marks: dict[float, int]) -> None:
    """Paint a grid line and a number for each error. Leave out numbers that would touch the one below."""
    above = -1
    for error, row in sorted(marks.items()):
        pixels[MARGIN_BOTTOM + row, MARGIN_LEFT:] = GRID_COLOR
        bottom = max(0, min(MARGIN_BOTTOM + row - 4, HEIGHT - 9))
        if bottom > above:
            text = f"{error:.10f}".rstrip("0").rstrip(".")
            _paint_number(pixels, text, max(0, MARGIN_LEFT - 4 - 8 * len(text)), bottom)
            above = bottom + 11


def _paint_number(pixels: "np.ndarray", text: str, left: int, bottom: int) -> None:
    """Paint a number, with glyphs of double width."""
    for index, character in enumerate(text):
        for row, bits in enumerate(DIGIT_GLYPHS[character]):
            for column in range(3):
                x, y = left + 8 * index + 2 * column, bottom + 8 - row
                if int(bits) >> (2 - column) & 1 and x + 2 <= WIDTH:
                    pixels[y, x : x + 2, :3] = TEXT_COLOR


def release() -> None:
    """Free the image."""
    global _previews, _drawn_key
    if _previews is not None:
        bpy.utils.previews.remove(_previews)
        _previews, _drawn_key = None, ()
