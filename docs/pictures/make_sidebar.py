# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes the pictures of the sidebar from those of `make test-gui`: `python docs/pictures/make_sidebar.py out/gui`."""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

HERE = Path(__file__).parent
SIDEBAR = (1028, 82, 1284)
"""Left, top and right in the window of the test, pixels."""
VIEW = (2, 62, 1312, 1090)
INK = 150
"""Of the darkest channel of what is written."""
BELOW = 16
GAP = 12
MANUAL = {
    "manual_prepare": ("03_measure_the_rig", "04_show_a_random_pose", "07_record"),
    "simulation_sections": ("target", "flesh_recorded"),
    "manual_play": ("09_train", "12_measure_the_model", "14_evaluate"),
}
"""Pictures of sections beside each other, and the steps that they come from."""
WHOLE = {
    "sidebar_evaluation": "17_mark_the_worst_frames",
    "manual_heat_map": "16_show_the_heat_map",
    "simulation_settling": "settling",
    "simulation_plays": "flesh_plays",
}


def height_of_sections(picture: Image.Image) -> int:
    """How far down the sidebar is written on."""
    left, top, right = SIDEBAR
    pixels = np.asarray(picture.convert("RGB"))[top : VIEW[3], left:right]
    return int(np.flatnonzero((pixels.min(axis=2) > INK).any(axis=1))[-1]) + BELOW


def sections(picture: Image.Image) -> Image.Image:
    """The sidebar alone."""
    left, top, right = SIDEBAR
    return picture.crop((left, top, right, top + height_of_sections(picture)))


def beside(pictures: list[Image.Image]) -> Image.Image:
    """Pictures in a row, on the ground of the interface."""
    width = sum(picture.width for picture in pictures) + GAP * (len(pictures) - 1)
    row, x = Image.new("RGB", (width, max(picture.height for picture in pictures)), (48, 48, 48)), 0
    for picture in pictures:
        row.paste(picture, (x, 0))
        x += picture.width + GAP
    return row


def write(picture: Image.Image, name: str) -> None:
    picture.convert("RGB").quantize(256).save(HERE / f"{name}.png", optimize=True)


if __name__ == "__main__":
    folder = Path(sys.argv[1])

    def step(name: str) -> Image.Image:
        return Image.open(folder / f"{name}.png")

    for name, steps in MANUAL.items():
        write(beside([sections(step(each)) for each in steps]), name)
    for name, each in WHOLE.items():
        write(step(each).crop(VIEW), name)
