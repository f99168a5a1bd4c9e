# SPDX-License-Identifier: GPL-3.0-or-later
"""Make the pictures of the documentation from the files of `make demo`: `make pictures`.

The pictures of the demo become smaller. The animated picture `film.webp`, with which the README opens, is rendered.
"""

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import bpy
from PIL import Image

from benchmarks.demo import VIEW
from docs.pictures.make_films import evaluate_demo
from fdda_addon import register, unregister
from fdda_addon.evaluation.film import COMPARISON, FilmSettings, render_frames

WIDTH = 960
HERE = Path(__file__).parent
FILM_STEP_FRAMES, MAX_FILM_BYTES = 2, 3_000_000
"""The animated picture shows each second frame of the action, at half the frame rate. Limit for its size."""
FILM_QUALITY = 60


def shrink(source: Path, target: Path) -> None:
    """Scale a PNG file to `WIDTH` pixels."""
    image = bpy.data.images.load(str(source.absolute()))
    width, height = image.size
    image.scale(WIDTH, round(height * WIDTH / width))
    image.filepath_raw, image.file_format = str(target), "PNG"
    image.save(quality=95)
    bpy.data.images.remove(image)


def make_film(demo_folder: Path, target: Path) -> None:
    """Render the action of the arm, and write it as an animated WebP picture."""
    scene_rig, model, errors, _ = evaluate_demo(demo_folder)
    fps = bpy.context.scene.render.fps
    settings = FilmSettings(COMPARISON, VIEW, fps, width=WIDTH, text_scale=1.2)
    with tempfile.TemporaryDirectory() as folder:
        pictures = []
        for path, _ in render_frames(scene_rig, model, errors, 1, Path(folder), settings, FILM_STEP_FRAMES):
            with Image.open(path) as picture:
                pictures.append(picture.convert("RGB"))
    duration_ms = round(1000 * FILM_STEP_FRAMES / fps)
    options = {"save_all": True, "append_images": pictures[1:], "duration": duration_ms, "loop": 0}
    pictures[0].save(target, quality=FILM_QUALITY, method=4, **options)
    if target.stat().st_size > MAX_FILM_BYTES:
        raise SystemExit(f"{target} is larger than {MAX_FILM_BYTES / 1e6:g} MB; lower FILM_QUALITY.")


def main(demo_folder: Path) -> None:
    for picture in sorted((demo_folder / "pictures").glob("*.png")):
        shrink(picture, HERE / picture.name.partition("_")[2])
    register()
    try:
        make_film(demo_folder, HERE / "film.webp")
    finally:
        unregister()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
