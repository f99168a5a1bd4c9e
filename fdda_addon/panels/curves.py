# SPDX-License-Identifier: GPL-3.0-or-later
"""Draws the error curves of a training in a panel. The curves are a preview image in memory."""

import math

import bpy
import numpy as np

WIDTH, HEIGHT = 224, 224
MARGIN_LEFT, MARGIN_BOTTOM = 34, 16
"""Space for the numbers at the axes, pixels."""
LINE_HALF_WIDTH = 1.6
"""Half the width of a line, pixels."""
LEGEND = {
    "training": ("Seen Poses", "COLORSET_04_VEC", (0.25, 0.55, 1.0)),
    "validation": ("Unseen Poses", "COLORSET_02_VEC", (1.0, 0.55, 0.2)),
}
BACKGROUND_COLOR, GRID_COLOR = (0.10, 0.10, 0.10, 1.0), (0.20, 0.20, 0.20, 1.0)
TEXT_COLOR = (0.75, 0.75, 0.75)
TICK_STEPS = (1, 2, 5)
"""Errors that get a grid line and a number, multiplied by each power of ten."""
DIGIT_GLYPHS = {
    "0": "757555557", "1": "262222227", "2": "711744447", "3": "711711117", "4": "555711111", "5": "744711117",
    "6": "744755557", "7": "711111111", "8": "757557557", "9": "757711117", ".": "000000002",
}  # fmt: skip
"""Glyphs of 3 by 9 pixels. Each digit of a string is a row of 3 bits."""


class CurvesImage:
    """The preview image of the curves that were drawn last. It is made by the first `icon` and freed by `release`."""

    def __init__(self) -> None:
        self._previews: object = None
        # The curves are stored too, because a new object could get the id of a freed one.
        self._drawn: tuple[dict[str, list[float]] | None, list[int]] = None, []

    def icon(self, curves: dict[str, list[float]]) -> int:
        """Return the icon of the curves. Paint it again when the curves have new values."""
        import bpy.utils.previews

        if self._previews is None:
            self._previews = bpy.utils.previews.new()
            self._previews.new("curves").image_size = (WIDTH, HEIGHT)
        preview, lengths = self._previews["curves"], [len(curve) for curve in curves.values()]
        if self._drawn[0] is not curves or self._drawn[1] != lengths:
            self._drawn = curves, lengths
            preview.image_pixels_float.foreach_set(np.ravel(paint(curves)))
        return preview.icon_id

    def release(self) -> None:
        """Free the image."""
        if self._previews is not None:
            bpy.utils.previews.remove(self._previews)
            self._previews, self._drawn = None, (None, [])


image = CurvesImage()


def draw(layout: bpy.types.UILayout, curves: dict[str, list[float]]) -> None:
    """Draw error curves by epoch on a logarithmic scale, with a legend. Draw nothing before the second epoch."""
    lengths = [len(curves.get(name, ())) for name in LEGEND]
    if min(lengths) < 2:
        return
    layout.label(text="Error (mm) per Pass")
    layout.template_icon(icon_value=image.icon(curves), scale=9)
    column = layout.column(align=True)
    for name, (label, icon, _) in LEGEND.items():
        column.label(text=f"{label}: {curves[name][-1]:.3f} mm", icon=icon)


def paint(curves: "dict[str, list[float]]") -> "np.ndarray":
    """Return an image of the curves with axes: (HEIGHT, WIDTH, 4) float32 RGBA, rows from the bottom."""
    pixels = np.empty((HEIGHT, WIDTH, 4), np.float32)
    pixels[:] = BACKGROUND_COLOR
    log_errors = {name: np.log10(np.maximum(curves[name], 1e-6)) for name in LEGEND}
    log_min, log_max = min(log.min() for log in log_errors.values()), max(log.max() for log in log_errors.values())
    margin = max(0.05 * (log_max - log_min), 0.02)
    log_min, log_max = log_min - margin, log_max + margin
    plot_pixels = pixels[MARGIN_BOTTOM:, MARGIN_LEFT:]
    height, width = plot_pixels.shape[:2]

    def to_row(log: "np.ndarray | float") -> "np.ndarray | float":
        return (log - log_min) / (log_max - log_min) * (height - 1)

    low, high = 10**log_min, 10**log_max
    decades = range(math.floor(log_min), math.ceil(log_max) + 1)
    ticks = [tick * 10.0**decade for decade in decades for tick in TICK_STEPS if low <= tick * 10.0**decade <= high]
    powers_of_ten = [tick for tick in ticks if round(math.log10(tick), 6) % 1 == 0]
    min_bottom = -1
    for error in sorted(powers_of_ten if len(powers_of_ten) > 2 else ticks):
        row = round(to_row(float(np.log10(error))))
        pixels[MARGIN_BOTTOM + row, MARGIN_LEFT:] = GRID_COLOR
        bottom = max(0, min(MARGIN_BOTTOM + row - 4, HEIGHT - 9))
        # Leave out a number that would touch the number below it.
        if bottom > min_bottom:
            text = f"{error:.10f}".rstrip("0").rstrip(".")
            _paint_number(pixels, text, max(0, MARGIN_LEFT - 4 - 8 * len(text)), bottom)
            min_bottom = bottom + 11
    count = len(log_errors["training"])
    _paint_number(pixels, "1", MARGIN_LEFT, 3)
    _paint_number(pixels, str(count), WIDTH - 8 * len(str(count)), 3)
    rows = np.arange(height)[:, None]
    for name, (_, _, color) in LEGEND.items():
        columns = np.linspace(0, count - 1, width)
        heights = to_row(np.interp(columns, np.arange(count), log_errors[name]))
        next_heights = np.append(heights[1:], heights[-1])
        bottom, top = (
            np.minimum(heights, next_heights) - LINE_HALF_WIDTH,
            np.maximum(heights, next_heights) + LINE_HALF_WIDTH,
        )
        # Antialiasing: the coverage falls from 1 to 0 within one pixel.
        coverage = np.clip(np.minimum(rows - bottom, top - rows) + 0.5, 0, 1)[..., None]
        plot_pixels[..., :3] += coverage * (np.float32(color) - plot_pixels[..., :3])
    return pixels


def _paint_number(pixels: "np.ndarray", text: str, left: int, bottom: int) -> None:
    """Paint a number, with glyphs of double width."""
    for index, character in enumerate(text):
        for row, bits in enumerate(DIGIT_GLYPHS[character]):
            for column in range(3):
                x, y = left + 8 * index + 2 * column, bottom + 8 - row
                if int(bits) >> (2 - column) & 1 and x + 2 <= WIDTH:
                    pixels[y, x : x + 2, :3] = TEXT_COLOR
