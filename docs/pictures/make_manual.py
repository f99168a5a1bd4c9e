# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the manual's pictures of the window: `python docs/pictures/make_manual.py out/gui`.

The screenshots, and the positions of what is drawn on them, come from `tests/gui/run.py out/gui --story path manual`.
"""

import json
import math
import sys
from pathlib import Path

import numpy as np
from make_sidebar import (
    BOTTOM_MARGIN,
    COLUMN_GAP,
    SIDEBAR_BOUNDS,
    TEXT_BRIGHTNESS,
    crop_sections,
    join_pictures,
    write_picture,
)
from PIL import Image, ImageDraw, ImageFont

BADGE_RADIUS, BADGE_COLOR, TEXT_COLOR = 12, (255, 150, 40), (20, 20, 20)
CAPTION_HEIGHT, CAPTION_COLOR = 30, (220, 220, 220)
AXIS_COLORS = ((255, 80, 90), (140, 220, 60), (90, 150, 255))
"""Colors of the axes X, Y and Z, as in Blender."""
SHRUNK_WIDTH, LIMITS_MARGIN = 760, 60
PREFERENCES_BOX = (172, 250, 1304, 612)
"""Left, top, right and bottom of the add-on's part in the area of the preferences, pixels."""
CURVE_INSET, TABS_WIDTH = 56, 34
"""Distance between the button Train and what its training shows, and width of the tabs of the Properties editor."""
SUPERSAMPLING = 4


def number_steps(picture: Image.Image, numbers: list) -> Image.Image:
    """Draw numbers in circles at their positions."""
    draw = ImageDraw.Draw(picture)
    for number, x, y in numbers:
        draw.circle((x, y), BADGE_RADIUS, fill=BADGE_COLOR)
        draw.text((x, y), str(number), TEXT_COLOR, ImageFont.load_default(16), anchor="mm")
    return picture


def add_caption(picture: Image.Image, caption: str) -> Image.Image:
    """Return the picture below a caption."""
    captioned = Image.new("RGB", (picture.width, picture.height + CAPTION_HEIGHT), (48, 48, 48))
    captioned.paste(picture, (0, CAPTION_HEIGHT))
    ImageDraw.Draw(captioned).text((8, 6), caption, CAPTION_COLOR, ImageFont.load_default(16))
    return captioned


def stack(pictures: list[Image.Image]) -> Image.Image:
    """Return the pictures below each other."""
    height = sum(picture.height for picture in pictures) + COLUMN_GAP * (len(pictures) - 1)
    column, y = Image.new("RGB", (max(picture.width for picture in pictures), height), (48, 48, 48)), 0
    for picture in pictures:
        column.paste(picture, (0, y))
        y += picture.height + COLUMN_GAP
    return column


def draw_arcs(picture: Image.Image, arcs: list[dict]) -> Image.Image:
    """Draw the arcs of limits, filled and in the colors of their axes, with the angles at their ends."""
    size = (picture.width * SUPERSAMPLING, picture.height * SUPERSAMPLING)
    layer = Image.new("RGBA", size, (0, 0, 0, 0))
    draw, font = ImageDraw.Draw(layer), ImageFont.load_default(22 * SUPERSAMPLING)
    for arc in arcs:
        color = AXIS_COLORS[arc["axis"]]
        center, *points = [tuple(value * SUPERSAMPLING for value in point) for point in (arc["center"], *arc["points"])]
        draw.polygon([center, *points], fill=(*color, 70))
        draw.line([center, *points, center], fill=(*color, 255), width=2 * SUPERSAMPLING)
        for angle, (x, y) in ((arc["low"], points[0]), (arc["high"], points[-1])):
            length = math.dist((x, y), center) or 1.0
            offset = 24 * SUPERSAMPLING / length
            place = (x + (x - center[0]) * offset, y + (y - center[1]) * offset)
            draw.text(place, f"{math.degrees(angle):.0f}°", (255, 255, 255, 255), font, anchor="mm")
    layer = layer.resize(picture.size, Image.Resampling.LANCZOS)
    return Image.alpha_composite(picture.convert("RGBA"), layer).convert("RGB")


class Screenshots:
    """The screenshots of the story `manual`, with what is to be drawn on them."""

    def __init__(self, folder: Path):
        self._folder = folder
        self.marks = json.loads((folder / "marks.json").read_text(encoding="utf-8"))

    def open(self, name: str) -> Image.Image:
        """Open a screenshot without numbers."""
        return Image.open(self._folder / f"{name}.png").convert("RGB")

    def column(self, *names: str) -> Image.Image:
        """Return the sidebar of screenshots with their numbers, below each other."""
        numbered = [number_steps(self.open(name), self.marks[name]["numbers"]) for name in names]
        return stack([crop_sections(picture) for picture in numbered])

    def curves(self, name: str) -> Image.Image:
        """Return what the section Training shows between the buttons Train Again and Bind."""
        left, _, right = SIDEBAR_BOUNDS
        top, bottom = map(round, self.marks[name]["rows"])
        return self.open(name).crop((left, top + CURVE_INSET, right, bottom - BADGE_RADIUS))

    def modifiers(self, name: str) -> Image.Image:
        """Return the list of modifiers in the Properties editor."""
        left, top, right, bottom = self.marks[name]["area"]
        picture = self.open(name).crop((left + TABS_WIDTH, top, right, bottom))
        rows = (np.asarray(picture).min(axis=2) > TEXT_BRIGHTNESS).any(axis=1)
        return picture.crop((0, 0, picture.width, int(np.flatnonzero(rows)[-1]) + BOTTOM_MARGIN))

    def limits(self, name: str) -> Image.Image:
        """Return the part of the viewport with the arcs."""
        arcs, (left, _, right, _) = self.marks[name]["arcs"], self.marks[name]["area"]
        heights = [y for arc in arcs for _, y in arc["points"]]
        top, bottom = round(min(heights)) - LIMITS_MARGIN, round(max(heights)) + LIMITS_MARGIN
        return draw_arcs(self.open(name), arcs).crop((left + LIMITS_MARGIN, top, right - LIMITS_MARGIN, bottom))

    def preferences(self, name: str) -> Image.Image:
        """Return the preferences of the add-on."""
        return self.open(name).crop(self.marks[name]["area"]).crop(PREFERENCES_BOX)


def shrink(picture: Image.Image, width: int) -> Image.Image:
    return picture.resize((width, picture.height * width // picture.width), Image.Resampling.LANCZOS)


def main(folder: Path) -> None:
    shots = Screenshots(folder)
    prepare = (("manual_empty", "manual_rig"), ("manual_poses",), ("manual_recording",))
    play = (("manual_training",), ("manual_model", "manual_models"), ("manual_evaluation",))
    for name, columns in (("manual_prepare", prepare), ("manual_play", play)):
        write_picture(join_pictures([shots.column(*names) for names in columns]), name)
    curves = (("manual_training", "1,000 poses"), ("manual_few_poses", "25 poses"))
    write_picture(
        join_pictures([add_caption(shots.curves(name), caption) for name, caption in curves]), "manual_curves"
    )
    stacks = (("manual_modifiers_before", "before Bind"), ("manual_modifiers_after", "after Bind"))
    modifiers = [add_caption(shots.modifiers(name), caption) for name, caption in stacks]
    write_picture(join_pictures(modifiers), "manual_modifiers")
    write_picture(shrink(shots.limits("manual_limits"), SHRUNK_WIDTH), "manual_limits")
    write_picture(shrink(shots.preferences("manual_preferences"), SHRUNK_WIDTH), "manual_preferences")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
