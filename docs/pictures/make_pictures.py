# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the small pictures of the documentation from those of `make demo`: `make pictures`."""

import sys
from pathlib import Path

import bpy

WIDTH = 960
HERE = Path(__file__).parent


def shrink(source: Path, target: Path) -> None:
    """Scale a PNG file to `WIDTH` pixels."""
    image = bpy.data.images.load(str(source.absolute()))
    width, height = image.size
    image.scale(WIDTH, round(height * WIDTH / width))
    image.filepath_raw, image.file_format = str(target), "PNG"
    image.save(quality=95)
    bpy.data.images.remove(image)


if __name__ == "__main__":
    for picture in sorted(Path(sys.argv[1]).glob("*.png")):
        shrink(picture, HERE / picture.name.partition("_")[2])
