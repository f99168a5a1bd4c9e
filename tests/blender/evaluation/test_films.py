# SPDX-License-Identifier: GPL-3.0-or-later
"""Films: the verb and the button write videos that Blender can read, or nothing at all."""

from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from blend_fixtures.elbow import ACTION
from fdda_addon.core.errors import ModelError, OutputError
from fdda_addon.core.progress import Progress, run_job
from fdda_addon.evaluation import video
from fdda_addon.evaluation.film import (
    FDDA,
    FDDA_ERROR,
    RIG,
    Film,
    FilmSettings,
    _centers_and_size,
    film,
    render_frames,
    round_up,
)
from fdda_addon.evaluation.picture import Cell, View, draw
from fdda_addon.evaluation.results import PoseErrors
from fdda_addon.evaluation.run import evaluate_action
from fdda_addon.scene.scene_rig import SceneRig

from ..conftest import ELBOW, run

FIRST, LAST = 6, 9
SMALL = FilmSettings(columns=(RIG, FDDA, FDDA_ERROR), width=320)


def shorten_action() -> None:
    """Limit the action of the elbow to a few frames."""
    action = bpy.data.actions[ACTION]
    action.use_frame_range, action.frame_start, action.frame_end = True, FIRST, LAST


@pytest.fixture
def errors(rig: SceneRig, elbow_files) -> PoseErrors:
    """Return the errors on the shortened action of the elbow, whose file is open."""
    shorten_action()
    return run_job(evaluate_action(rig, elbow_files.model, ACTION)).held_out


def read_picture(path: Path) -> np.ndarray:
    """Return the pixels of a picture, (H, W, 3) float32, rows from the bottom."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    return values.reshape(height, width, -1)[..., :3]


def read_video(path: Path, folder: Path) -> tuple[float, list[np.ndarray]]:
    """Return the frames per second of a video, and its frames as (H, W, 3) float32, rows from the bottom."""
    scene = bpy.data.scenes.new("read video")
    strip = scene.sequence_editor_create().strips.new_movie("movie", str(path), 1, 1)
    element = strip.elements[0]
    scene.render.resolution_x, scene.render.resolution_y = element.orig_width, element.orig_height
    scene.frame_start, scene.frame_end = 1, round(strip.frame_final_end - strip.frame_final_start)
    scene.render.filepath = str(folder / "frame_###")
    bpy.ops.render.render(animation=True, scene=scene.name)
    frames = [read_picture(folder / f"frame_{frame:03}.png") for frame in range(1, scene.frame_end + 1)]
    fps = element.orig_fps
    bpy.data.scenes.remove(scene)
    return fps, frames


def datablocks() -> dict[str, int]:
    """Return the numbers of datablocks that a film creates for a while."""
    names = ("scenes", "objects", "meshes", "curves", "cameras", "worlds")
    return {name: len(getattr(bpy.data, name)) for name in names}


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_verb_writes_a_film_of_the_action(rig: SceneRig, elbow_files, tmp_path: Path, capfd):
    shorten_action()
    bpy.context.scene.render.fps = 30
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "elbow.blend"))
    out, options = tmp_path / "film.mp4", ["--json", tmp_path / "e.json", "--poses", 0, "--action", ACTION]
    assert run("evaluate", tmp_path / "elbow.blend", elbow_files.model, *options, "--video", out) == 0
    assert "Saved:" not in capfd.readouterr().out, "stdout is for results"
    fps, frames = read_video(out, tmp_path)
    assert fps == pytest.approx(30) and len(frames) == LAST - FIRST + 1
    assert frames[0].shape[1] <= 1600 and not any(size % 2 for size in frames[0].shape[:2])
    # The elbow bends, so each column changes.
    columns = np.array_split(np.abs(frames[-1] - frames[0]).max(axis=2), 4, axis=1)
    assert min((column > 0.1).mean() for column in columns) > 0.001
    # Only the last column is a heat map. The color scale is at the bottom.
    meshes = frames[0][frames[0].shape[0] // 5 :]
    colored = [(np.ptp(column, axis=2) > 0.5).mean() for column in np.array_split(meshes, 4, axis=1)]
    assert colored[3] > 0.02 and max(colored[1:3]) < 0.005


@pytest.mark.parametrize("suffix", [".mp4", ".webm"])
def test_a_film_is_written_in_both_formats(errors: PoseErrors, rig: SceneRig, elbow_files, tmp_path: Path, suffix: str):
    before, out = datablocks(), tmp_path / f"film{suffix}"
    progress = []
    result = run_job(film(rig, elbow_files.model, errors, FIRST, out, SMALL), progress.append)
    assert list(dict.fromkeys(step.stage for step in progress)) == ["film", "encoding"]
    assert progress[3] == Progress("film", 4, 4) and progress[-1] == Progress("encoding", 4, 4)
    assert isinstance(result, Film) and result.frames == 4
    _, frames = read_video(out, tmp_path)
    assert len(frames) == 4 and frames[0].shape[:2] == result.size[::-1]
    assert datablocks() == before and {path.name for path in tmp_path.iterdir() if path.suffix != ".png"} == {out.name}


def test_a_closed_or_refused_film_leaves_nothing(errors: PoseErrors, rig: SceneRig, elbow_files, tmp_path: Path):
    out, before = tmp_path / "film.mp4", datablocks()
    with pytest.raises(ModelError):
        next(film(rig, tmp_path / "none.onnx", errors, FIRST, out, SMALL))
    assert datablocks() == before
    steps = film(rig, elbow_files.model, errors, FIRST, out, SMALL)
    assert next(steps) == Progress("film", 1, 4) and any(tmp_path.iterdir())
    steps.close()
    assert list(tmp_path.iterdir()) == [] and datablocks() == before


def test_a_film_that_is_closed_while_it_is_encoded_leaves_nothing(
    errors: PoseErrors, rig: SceneRig, elbow_files, tmp_path: Path
):
    steps = film(rig, elbow_files.model, errors, FIRST, tmp_path / "film.mp4", SMALL)
    while next(steps) is not None:
        pass
    steps.close()
    assert list(tmp_path.iterdir()) == []


def test_a_missing_encoder_is_reported_and_keeps_the_old_film(
    errors: PoseErrors, rig: SceneRig, elbow_files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """This Blender lacks the encoder of Theora."""
    out, before = tmp_path / "film.mp4", datablocks()
    out.write_bytes(b"old")
    monkeypatch.setitem(video.ENCODINGS, ".mp4", ("MPEG4", "THEORA", "Theora"))
    with pytest.raises(
        OutputError, match=r"film\.mp4': .+ lacks the encoder of Theora: try a name that ends in \.webm; nothing was"
    ):
        list(film(rig, elbow_files.model, errors, FIRST, out, SMALL))
    assert files_in(tmp_path) == {"film.mp4": b"old"} and datablocks() == before


def test_the_view_follows_a_character_that_walks_away(errors: PoseErrors):
    axes = View().axes()
    centers, size = _centers_and_size(errors.positions, axes)
    assert np.ptp(centers, axis=0).max() == 0
    path = np.linspace(0, 30, 60)[:, None, None] * np.array([1.0, 0, 0])
    walk = np.repeat(errors.positions[:1], 60, axis=0) + path
    walk_centers, walk_size = _centers_and_size(walk, axes)
    assert walk_centers[-1] @ axes[:, 0] - walk_centers[0] @ axes[:, 0] > 20 and walk_size[0] < 20 * size[0]
    relative = np.abs(walk @ axes.T - walk_centers[:, None])[..., :2]
    assert (relative <= walk_size / 2 + 1e-6).all()


@pytest.mark.parametrize(("meters", "rounded"), [(0.00013, 0.0002), (0.002, 0.002), (0.0071, 0.01), (0.0, 1e-6)])
def test_color_ranges_are_round(meters: float, rounded: float):
    assert round_up(meters) == pytest.approx(rounded)


def test_a_view_has_the_direction_of_the_viewport():
    for view in (View(15, 50), View(-120, -30), View(0, 0)):
        result = View.from_direction(view.axes()[2])
        assert (result.azimuth, result.elevation) == pytest.approx((view.azimuth, view.elevation))


@pytest.mark.parametrize("scale", [0.01, 20000.0])
def test_a_character_stands_upright_as_in_the_world(rig: SceneRig, tmp_path: Path, scale: float):
    """Importers turn objects, in any unit: the picture is that of the same mesh, not turned."""
    mesh_object = rig.mesh_object
    positions = np.array([vertex.co for vertex in mesh_object.data.vertices], np.float32)
    colors = np.full((len(positions), 3), 0.7, np.float32)
    mesh_object.parent, mesh_object.matrix_world = None, Matrix()
    bpy.context.view_layer.update()
    draw(mesh_object, [[Cell(positions, colors, "arm")]], tmp_path / "as_is.png", "", View())
    as_is = read_picture(tmp_path / "as_is.png")
    assert np.ptp(as_is) > 0.3
    turned = Matrix.Rotation(0.5 * np.pi, 4, "X") @ Matrix.Diagonal((scale, 2 * scale, scale, 1))
    mesh_object.data.transform(turned.inverted() @ Matrix.Scale(scale, 4))
    mesh_object.matrix_world = turned
    bpy.context.view_layer.update()
    positions = np.array([vertex.co for vertex in mesh_object.data.vertices], np.float32)
    draw(mesh_object, [[Cell(positions, colors, "arm")]], tmp_path / "turned.png", "", View())
    picture = read_picture(tmp_path / "turned.png")
    assert picture.shape == as_is.shape and np.abs(picture - as_is).mean() < 0.002


def test_the_picture_shows_the_frame_in_its_column(errors: PoseErrors, rig: SceneRig, elbow_files, tmp_path: Path):
    """The columns of rig and model look the same, as the model is close to the rig."""
    frames = render_frames(rig, elbow_files.model, errors, FIRST, tmp_path, SMALL)
    path, (width, _) = next(frames)
    frames.close()
    picture = read_picture(path)
    meshes = picture[: picture.shape[0] // 2]
    third = width // 3
    assert np.abs(meshes[:, third // 10 : third] - meshes[:, third + third // 10 : 2 * third]).mean() < 0.05


def test_the_button_renders_the_active_action(bound_elbow: bpy.types.Object, tmp_path: Path):
    shorten_action()
    out, before, mode = tmp_path / "film.mp4", datablocks(), bound_elbow.fdda.mode
    assert bpy.ops.fdda.render_comparison(object=ELBOW, filepath=str(out), direction=(0, -1, 0.2)) == {"FINISHED"}
    _, frames = read_video(out, tmp_path)
    assert len(frames) == 4
    assert datablocks() == before and bpy.data.objects[ELBOW].fdda.mode == mode
    with pytest.raises(RuntimeError, match=r"ends in neither \.mp4 nor \.webm"):
        bpy.ops.fdda.render_comparison(object=ELBOW, filepath=str(tmp_path / "film.avi"))
    other = tmp_path / "other.mp4"
    other.write_bytes(b"text of another program")
    with pytest.raises(RuntimeError, match=r"another file is there, which is not a video"):
        bpy.ops.fdda.render_comparison(object=ELBOW, filepath=str(other))
    assert other.read_bytes() == b"text of another program"


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--video", "film.mp4"], "--video shows the frames of an action; give --action or --strip"),
        (["--action", ACTION, "--video", "film.avi"], "ends in neither .mp4 nor .webm; give it the extension"),
    ],
)
def test_wrong_options_are_refused(
    elbow_files, tmp_path: Path, options: list[str], sentence: str, capsys: pytest.CaptureFixture
):
    assert run("evaluate", elbow_files.rig, elbow_files.model, "--json", tmp_path / "e.json", *options) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
    assert list(tmp_path.iterdir()) == []
