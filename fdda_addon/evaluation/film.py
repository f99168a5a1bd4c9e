# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders the film of an action: rig, linear skinning, model and heat maps side by side."""

import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import numpy as np

from ..core.errors import OutputError, os_error_text
from ..core.files.output import TEMPORARY_PREFIX
from ..core.mathematics.metrics import HEAT_MAP_STOPS, NO_ERROR_COLOR, NO_ERROR_METRES, distances, heat_colors
from ..core.mathematics.skinning import LinearSkinning
from ..core.progress import Job, Progress
from ..runtime.network import Network
from ..runtime.opened_model import open_model
from ..scene.mask import read_mask
from ..scene.mesh import set_mesh_positions
from ..scene.scene_rig import SceneRig
from .colored_mesh import MeshFactory, set_colors
from .picture import CELL_MARGIN_RATIO, Picture, View, check_can_render
from .pictures import SURFACE_COLOR
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
            pictures: list[Path] = []
            folder, size = Path(folder_name), (0, 0)
            with closing(render_frames(scene_rig, model, errors, first_frame, folder, settings)) as frames:
                for picture, size in frames:  # noqa: B007 - used after the loop
                    pictures.append(picture)
                    yield Progress("film", len(pictures), len(errors.positions))
            with closing(encode(pictures, path, size, settings.fps)) as counts:
                for count in counts:
                    yield Progress("encoding", count, len(pictures))
    except OSError as error:
        raise OutputError(f"Cannot write '{path}': {os_error_text(error)}; nothing was changed.") from error
    return Film(len(pictures), size)


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
    source = _FrameSource(scene_rig, model, errors, settings.columns)
    picture = _FilmPicture(scene_rig.mesh_object, source, settings)
    try:
        for index in range(0, len(errors.positions), step):
            picture.show(index, f"{errors.name}, frame {first_frame + index}")
            path = folder / f"{index:06}.png"
            picture.render(path)
            yield path, (picture.scene.render.resolution_x, picture.scene.render.resolution_y)
    finally:
        picture.remove()


class _FrameSource:
    """Computes the positions and errors of a frame.

    Attributes:
        errors: the evaluated frames.
        max_error: error with the last color of the heat map, meters.
    """

    def __init__(self, scene_rig: SceneRig, model: Path | Network, errors: PoseErrors, columns: tuple[str, ...]):
        opened = open_model(scene_rig, model)
        self._network, self._skinning = opened.network, LinearSkinning(opened.linear_rig)
        self._mask, self._metres_per_unit = read_mask(scene_rig.mesh_object), opened.network.info.metres_per_unit
        self.errors = errors
        shown_errors = errors.linear if LINEAR_ERROR in columns else errors.fdda
        self.max_error = round_up(float(np.percentile(shown_errors, COLOR_RANGE_PERCENTILE)))

    def positions(self, index: int) -> dict[str, np.ndarray]:
        """Return the positions of a frame by column, (V, 3) float32, mesh-object space, mesh units."""
        errors = self.errors
        matrices, controls = errors.pose_matrices[index : index + 1], errors.controls[index : index + 1]
        linear = self._skinning.positions(matrices)[0]
        fdda = self._network.positions(matrices, controls)[0].copy()
        if self._mask is not None:
            fdda = self._mask.blend(linear, fdda)
        return {RIG: errors.positions[index], LINEAR: linear, FDDA: fdda, LINEAR_ERROR: linear, FDDA_ERROR: fdda}

    def distances(self, positions: np.ndarray, index: int) -> np.ndarray:
        """Return the distances of positions from the rig in a frame, (V,) float32, meters."""
        return distances(positions, self.errors.positions[index], self._metres_per_unit)


def round_up(meters: float) -> float:
    """Return the next of 1, 2, 5, 10, 20… micrometers, for the range of a heat map."""
    exponent = np.floor(np.log10(max(meters, 1e-6)))
    return float(next(step * 10**exponent for step in (1, 2, 5, 10) if step * 10**exponent >= meters * 0.999))


class _FilmPicture(Picture):
    """A picture with a row of meshes that move from frame to frame."""

    def __init__(self, mesh_object: bpy.types.Object, source: _FrameSource, settings: FilmSettings):
        super().__init__(settings.view, mesh_object)
        self._source, self._settings = source, settings
        self._centers, cell_size = _centers_and_size(source.errors.positions, self.projection)
        self._cells: list[tuple[str, bpy.types.Mesh, bpy.types.TextCurve]] = []
        gap = cell_size[0] * CELL_MARGIN_RATIO
        # A tall character gets wider margins, so that texts fit above it.
        cell_width = max(cell_size[0] + gap, cell_size[1] * 0.5)
        self.width = len(settings.columns) * cell_width + gap
        size = self.width * TEXT_WIDTH_RATIO * settings.text_scale
        self._title = self.add_text("", (gap, -2.2 * size), 1.3 * size)
        mesh = mesh_object.data
        factory, count = MeshFactory(mesh), len(mesh.vertices)
        top = (3.4 + LABEL_LINES) * size
        for column, name in enumerate(settings.columns):
            left = gap + column * cell_width
            curve = self.add_text("", (left, -4.2 * size), size)
            cell_mesh = factory.create(np.zeros((count, 3), np.float32), np.tile(np.float32(SURFACE_COLOR), (count, 1)))
            center = (left + (cell_width - gap) / 2, -(top + size + cell_size[1] / 2))
            self.move(self.add_object("cell", cell_mesh), *center)
            self._cells.append((name, cell_mesh, curve))
        bottom = top + 2 * size + cell_size[1]
        if {LINEAR_ERROR, FDDA_ERROR} & set(settings.columns):
            # Add the colors of the heat map, from no error to `max_error`.
            x, y = gap, -(bottom + size)
            colors = heat_colors(np.linspace(HEAT_MAP_STOPS[0][0], HEAT_MAP_STOPS[-1][0], 64))
            self.add_strip((x, y), (size, size), np.array([NO_ERROR_COLOR, NO_ERROR_COLOR]))
            self.add_text(f"below {NO_ERROR_METRES * 1000:g} mm", (x + 1.5 * size, y), 0.9 * size)
            self.add_strip((x + 12 * size, y), (16 * size, size), colors)
            self.add_text(f"{self._source.max_error * 1000:g} mm and above", (x + 28.5 * size, y), 0.9 * size)
            bottom += 2.6 * size
        self.height = bottom + gap
        width = min(settings.width, int(MAX_HEIGHT * self.width / self.height))
        self.set_up_render(is_sculpted=False, width_pixels=width, antialiasing="FXAA")

    def show(self, index: int, title: str) -> None:
        """Show a frame, given its index, with a title."""
        source, times = self._source, self._settings.times_ms
        self._title.body = title
        positions_by_column = source.positions(index)
        for name, mesh, curve in self._cells:
            positions = positions_by_column[name]
            projected = (positions @ self.projection.T - self._centers[index]).astype(np.float32)
            set_mesh_positions(mesh, np.ascontiguousarray(projected))
            errors = source.distances(positions, index)
            if name in {LINEAR_ERROR, FDDA_ERROR}:
                set_colors(mesh, heat_colors(errors, source.max_error))
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
