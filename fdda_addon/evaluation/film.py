# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders the film of an action: rig, linear skinning, model and heat maps side by side."""

import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..core.errors import OutputError, os_error_text
from ..core.files.output import TEMPORARY_PREFIX
from ..core.mathematics.metrics import distances, heat_colors
from ..core.progress import Job, Progress
from ..runtime.network import Network
from ..scene.mesh import set_mesh_positions
from ..scene.scene_rig import SceneRig
from .picture import Picture, View, check_can_render, set_colors
from .pictures import SURFACE_COLOR, Deformations
from .results import PoseErrors
from .video import encode

RIG, LINEAR, FDDA, LINEAR_ERROR, FDDA_ERROR = "rig", "linear", "fdda", "linear error", "fdda error"
LABELS = {
    RIG: "Rig",
    LINEAR: "Linear skinning",
    FDDA: "FDDA",
    LINEAR_ERROR: "Linear skinning, error",
    FDDA_ERROR: "FDDA, error",
}
COMPARISON = (RIG, LINEAR, FDDA, FDDA_ERROR)
"""Columns of the film that compares everything."""
WIDTH, MAX_HEIGHT = 1600, 1080
"""Width of a film, and limit for its height, pixels."""
TEXT_WIDTH_RATIO = 0.0125
"""Height of a line of text, relative to the width of the film."""
LABEL_LINES = 3
COLOR_RANGE_PERCENTILE = 99.9
FOLLOWING_FRAMES = 24
"""Number of frames over which the view averages the place of a character that walks away."""


@dataclass(frozen=True)
class FilmSettings:
    """Settings of a film.

    Attributes:
        columns: what to show from left to right, among the keys of `LABELS`.
        view: the view direction.
        fps: frames per second.
        times_ms: milliseconds per frame by column; may lack columns.
        reference_label: label of the first column.
        width: largest width, pixels.
        text_scale: factor for the size of the texts.
    """

    columns: tuple[str, ...] = COMPARISON
    view: View = View()  # noqa: RUF009 - frozen
    fps: float = 24.0
    times_ms: dict[str, float] = field(default_factory=dict)
    reference_label: str = LABELS[RIG]
    width: int = WIDTH
    text_scale: float = 1.0


@dataclass(frozen=True)
class Film:
    """A film that was written.

    Attributes:
        frames: number of frames.
        size: width and height, pixels.
    """

    frames: int
    size: tuple[int, int]


def film(
    scene_rig: SceneRig, model: Path | Network, errors: PoseErrors, first_frame: int, path: Path, settings: FilmSettings
) -> Job[Film]:
    """Write the film of an action while the generator is iterated.

    The file appears when it is complete. Closing the generator leaves no file and no data.

    Args:
        model: path of the model, or the loaded model.
        errors: the frames of the action, evaluated.
        first_frame: number of the first frame.
        path: path of the video (`video.check_video_path`).

    Raises:
        ModelError: the model cannot be read, or was trained for another rig.
        OutputError: the film cannot be written.
    """
    try:
        with tempfile.TemporaryDirectory(
            prefix=TEMPORARY_PREFIX, dir=path.parent, ignore_cleanup_errors=True
        ) as folder_name:
            folder, count, size = Path(folder_name), 0, (0, 0)
            with closing(render_frames(scene_rig, model, errors, first_frame, folder, settings)) as frames:
                for count, (_, size) in enumerate(frames, 1):  # noqa: B007 - used after the loop
                    yield Progress("film", count, len(errors.positions))
            yield from encode(folder, path, size, settings.fps)
    except OSError as error:
        raise OutputError(f"Cannot write '{path}': {os_error_text(error)}; nothing was changed.") from error
    return Film(count, size)


def render_frames(
    scene_rig: SceneRig,
    model: Path | Network,
    errors: PoseErrors,
    first_frame: int,
    folder: Path,
    settings: FilmSettings,
    step: int = 1,
) -> Iterator[tuple[Path, tuple[int, int]]]:
    """Render each frame of a film, or each `step`-th frame, as PNG files; the other arguments are as for `film`.

    Yields:
        The path of each file, and its width and height in pixels.
    """
    check_can_render()
    picture = _FilmPicture(scene_rig, model, errors, settings)
    try:
        for index in range(0, len(errors.positions), step):
            picture.show(index, f"{errors.name}, frame {first_frame + index}")
            path = folder / f"{index:06}.png"
            picture.render(path)
            yield path, (picture.scene.render.resolution_x, picture.scene.render.resolution_y)
    finally:
        picture.remove()


def round_up(meters: float) -> float:
    """Return the next of 1, 2, 5, 10, 20… micrometers, for the range of a heat map."""
    exponent = np.floor(np.log10(max(meters, 1e-6)))
    return float(next(step * 10**exponent for step in (1, 2, 5, 10) if step * 10**exponent >= meters * 0.999))


class _FilmPicture(Picture):
    """A picture with a row of meshes that move from frame to frame."""

    def __init__(self, scene_rig: SceneRig, model: Path | Network, errors: PoseErrors, settings: FilmSettings):
        # First, because it refuses a wrong model.
        self._deformations, self._errors, self._settings = Deformations(scene_rig, model), errors, settings
        super().__init__(settings.view, scene_rig.mesh_object)
        self._centers, cell_size = _centers_and_size(errors.positions, self.projection)
        shown_errors = errors.linear if LINEAR_ERROR in settings.columns else errors.fdda
        # The error in meters that has the last color of the heat map.
        self._max_error = round_up(float(np.percentile(shown_errors, COLOR_RANGE_PERCENTILE)))
        cells = self.add_cells(
            scene_rig.mesh_object.data,
            cell_size,
            (1, len(settings.columns)),
            self._max_error if {LINEAR_ERROR, FDDA_ERROR} & set(settings.columns) else None,
            LABEL_LINES,
            TEXT_WIDTH_RATIO * settings.text_scale,
        )
        self._cells = [(name, *cell) for name, cell in zip(settings.columns, cells, strict=True)]
        for _, mesh, _ in self._cells:
            set_colors(mesh, np.tile(np.float32(SURFACE_COLOR), (len(mesh.vertices), 1)))
        width = min(settings.width, int(MAX_HEIGHT * self.width / self.height))
        self.set_up_render(is_sculpted=False, width_pixels=width, antialiasing="FXAA")

    def show(self, index: int, title: str) -> None:
        """Show a frame, given its index, with a title."""
        times, rig = self._settings.times_ms, self._errors.positions[index]
        self.title.body = title
        linear, fdda = self._deformations.positions(self._errors.pose_matrices[index], self._errors.controls[index])
        positions_by_column = {RIG: rig, LINEAR: linear, FDDA: fdda, LINEAR_ERROR: linear, FDDA_ERROR: fdda}
        for name, mesh, curve in self._cells:
            positions = positions_by_column[name]
            projected = (positions @ self.projection.T - self._centers[index]).astype(np.float32)
            set_mesh_positions(mesh, np.ascontiguousarray(projected))
            errors = distances(positions, rig, self._deformations.metres_per_unit)
            if name in {LINEAR_ERROR, FDDA_ERROR}:
                set_colors(mesh, heat_colors(errors, self._max_error))
            mesh.update()
            label = self._settings.reference_label if name == RIG else LABELS[name]
            if name in times:
                label += f"\n{times[name]:.2f} ms per frame"
            if name != RIG:
                label += f"\nerror: mean {errors.mean() * 1000:.2f} mm, max {errors.max() * 1000:.2f} mm"
            curve.body = label


def _centers_and_size(positions: np.ndarray, projection: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the view looks in each frame, and the size of a cell.

    The view stands still; if the character walks more than its own size, the view follows it.

    Args:
        positions: (N, V, 3) float32, mesh-object space, mesh units.
        projection: (3, 3) float64 (`Picture.projection`).

    Returns:
        (N, 3) float64 centers along the directions of the view, and (2,) float64 width and height.
    """
    bounds = np.array([[(p @ projection.T).min(axis=0), (p @ projection.T).max(axis=0)] for p in positions])
    lowest, highest = bounds[:, 0], bounds[:, 1]
    whole_size, largest_size = highest.max(axis=0) - lowest.min(axis=0), (highest - lowest).max(axis=0)
    if (whole_size <= 2 * largest_size)[:2].all():
        return np.tile((highest.max(axis=0) + lowest.min(axis=0)) / 2, (len(positions), 1)), whole_size[:2]
    centers = (highest + lowest) / 2
    padded = np.pad(centers, ((FOLLOWING_FRAMES // 2, FOLLOWING_FRAMES // 2), (0, 0)), mode="edge")
    smooth = np.array([padded[i : i + FOLLOWING_FRAMES + 1].mean(axis=0) for i in range(len(centers))])
    # The cell also holds the motion that the smooth path leaves out.
    rest = 2 * np.maximum(highest - smooth, smooth - lowest).max(axis=0)
    return smooth, rest[:2]
