# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the pictures of the window from those of `make test-gui`: `python docs/pictures/make_sidebar.py out/gui`.

`make_manual.py` makes those with numbers. The pictures of simulations are of a Blender that a person has used.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

HERE = Path(__file__).parent
SIDEBAR_BOUNDS = (1028, 82, 1284)
"""Left, top and right of the sidebar in the window of the test, pixels."""
VIEW_BOUNDS = (2, 62, 1312, 1090)
TEXT_BRIGHTNESS = 150
"""Pixels are part of a text if their darkest channel exceeds this value."""
BOTTOM_MARGIN = 16
COLUMN_GAP = 12
WINDOW_PICTURES = {
    "sidebar_evaluation": "17_jump_to_the_worst_frame",
    "manual_heat_map": "16_show_the_heat_map",
}
"""Steps of the story `path` whose window is shown, by the name of the picture."""


def sections_height(picture: Image.Image) -> int:
    """Return the height of the part of the sidebar that contains text, pixels."""
    left, top, right = SIDEBAR_BOUNDS
    pixels = np.asarray(picture.convert("RGB"))[top : VIEW_BOUNDS[3], left:right]
    return int(np.flatnonzero((pixels.min(axis=2) > TEXT_BRIGHTNESS).any(axis=1))[-1]) + BOTTOM_MARGIN


def crop_sections(picture: Image.Image) -> Image.Image:
    """Return the part of the window with the sections of the sidebar."""
    left, top, right = SIDEBAR_BOUNDS
    return picture.crop((left, top, right, min(top + sections_height(picture), VIEW_BOUNDS[3] - BOTTOM_MARGIN)))


def join_pictures(pictures: list[Image.Image]) -> Image.Image:
    """Return the pictures in a row, on the background color of Blender's interface."""
    width = sum(picture.width for picture in pictures) + COLUMN_GAP * (len(pictures) - 1)
    row, x = Image.new("RGB", (width, max(picture.height for picture in pictures)), (48, 48, 48)), 0
    for picture in pictures:
        row.paste(picture, (x, 0))
        x += picture.width + COLUMN_GAP
    return row


def write_picture(picture: Image.Image, name: str) -> None:
    """Write a picture of this folder with a palette of 256 colors."""
    picture.convert("RGB").quantize(256).save(HERE / f"{name}.png", optimize=True)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    for name, step in WINDOW_PICTURES.items():
        write_picture(Image.open(folder / f"{step}.png").crop(VIEW_BOUNDS), name)
