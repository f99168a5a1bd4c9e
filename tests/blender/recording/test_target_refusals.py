# SPDX-License-Identifier: GPL-3.0-or-later
"""Targets that are refused, and harmless differences that are accepted."""

from pathlib import Path

import bpy
import pytest

from blend_fixtures.characters import targets
from blend_fixtures.elbow import ACTION, FRAMES

from ..conftest import run
from ..refusals import Refusal
from .test_targets import built, of_flesh


def change(build, work, path: Path) -> Path:
    """Build a character, change it and save it; return the path of the file."""

    def both() -> None:
        build()
        work()

    return built(both, path)


def refused(refusal: Refusal, rig: Path, *options: object, target: str = "flesh") -> str:
    return refusal(
        "record",
        rig,
        rig.parent / "recording",
        "--object",
        "elbow",
        "--learn-from",
        target,
        "--action",
        ACTION,
        *options,
    )


def add_vertices() -> None:
    bpy.data.objects["flesh"].data.vertices.add(3)


def test_a_target_with_another_number_of_vertices_is_refused(refusal, tmp_path):
    rig = change(targets.target_copy, add_vertices, tmp_path / "rig.blend")
    assert refused(refusal, rig) == (
        "The target 'flesh' has 303 vertices and 'elbow' has 300; a target needs the same vertices in the same order."
    )


def test_a_target_with_other_faces_is_refused(refusal, tmp_path):
    def turn() -> None:
        mesh = bpy.data.objects["flesh"].data
        for loop in mesh.loops[:4]:
            loop.vertex_index += 5

    rig = change(targets.target_copy, turn, tmp_path / "rig.blend")
    assert refused(refusal, rig).startswith("The target 'flesh' has as many vertices as 'elbow' and other faces, so")


def test_faces_in_another_order_are_accepted(tmp_path):
    def reverse() -> None:
        mesh = bpy.data.objects["flesh"].data
        faces = [tuple(face.vertices)[::-1] for face in mesh.polygons][::-1]
        points = [vertex.co[:] for vertex in mesh.vertices]
        mesh.clear_geometry()
        mesh.from_pydata(points, [], faces)

    rig = change(targets.target_pc2, reverse, tmp_path / "rig.blend")
    assert len(of_flesh(rig, tmp_path / "recording").positions) >= FRAMES


@pytest.mark.parametrize(
    ("start", "scale", "first", "last"),
    [(5, 1, 5, FRAMES + 4), (2, 2, 1, (FRAMES + 1) / 2), (2, 0.5, 4, 2 * FRAMES + 2)],
)
def test_frames_outside_a_cache_are_refused(refusal, tmp_path, start, scale, first, last):
    def later() -> None:
        cache = bpy.data.objects["flesh"].modifiers["Cache"]
        cache.frame_start, cache.frame_scale = start, scale

    rig = change(targets.target_pc2, later, tmp_path / "rig.blend")
    assert refused(refusal, rig) == (
        f"The action '{ACTION}' has the frames 1 to {FRAMES}, and the modifier 'Cache' of 'flesh' has those from "
        f"{first} to {last:g}; record an action within, or give it more frames."
    )


@pytest.mark.parametrize("build", [targets.target_alembic, targets.target_usd])
def test_frames_outside_a_file_are_refused(build, refusal, tmp_path):
    def shift() -> None:
        bpy.data.cache_files[0].frame_offset = 3

    rig = change(build, shift, tmp_path / "rig.blend")
    assert f" has the frames 1 to {FRAMES}, and the modifier 'MeshSequenceCache' of 'flesh' has those from 4 to " in (
        refused(refusal, rig)
    )


def test_a_missing_file_is_refused(refusal, capfd, tmp_path):
    gone = tmp_path.resolve() / "nowhere"

    def lose() -> None:
        bpy.data.objects["flesh"].modifiers["Cache"].filepath = str(gone / "flesh.pc2")

    rig = change(targets.target_pc2, lose, tmp_path / "rig.blend")
    assert refused(refusal, rig) == (
        f"The modifier 'Cache' of 'flesh' plays the file '{gone / 'flesh.pc2'}', which is not there; put it there, or "
        "choose another file in the modifier."
    )

    def lose_file() -> None:
        bpy.data.cache_files[0].filepath = str(gone / "flesh.abc")

    rig = change(targets.target_alembic, lose_file, tmp_path / "other.blend")
    assert (
        run("record", rig, tmp_path / "recording", "--object", "elbow", "--learn-from", "flesh", "--action", ACTION)
        == 1
    )
    # Blender says something itself.
    assert f"plays the file '{gone / 'flesh.abc'}', which is not there" in capfd.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "recording").exists()


def test_a_damaged_file_is_refused(refusal, tmp_path):
    rig = built(targets.target_mdd, tmp_path / "rig.blend")
    path = Path(bpy.data.objects["flesh"].modifiers["Cache"].filepath)
    path.write_bytes(path.read_bytes()[:-5])
    assert refused(refusal, rig).startswith(
        "The modifier 'Cache' of 'flesh' plays a file that cannot be read. The point"
    )


def test_the_mesh_itself_is_refused_as_target(refusal, tmp_path):
    rig = built(targets.target_copy, tmp_path / "rig.blend")
    assert refused(refusal, rig, target="elbow").startswith("'elbow' cannot be its own target: a target is another")


def test_an_unknown_target_is_refused(refusal, tmp_path):
    rig = built(targets.target_copy, tmp_path / "rig.blend")
    assert refused(refusal, rig, target="skin") == (
        "The scene has no mesh object 'skin' to be the target; its other mesh objects: 'flesh'."
    )


def test_a_target_that_plays_a_model_is_refused(refusal, elbow_files, tmp_path):
    def bind() -> None:
        from fdda_addon.runtime.binding import bind as bind_model
        from fdda_addon.scene.scene_rig import find_rig

        bind_model(find_rig("flesh"), elbow_files.model)

    rig = change(targets.target_copy, bind, tmp_path / "rig.blend")
    assert refused(refusal, rig).startswith("The target 'flesh' plays a model, so there is nothing to learn from it")


def test_a_target_that_does_not_move_is_refused(refusal, tmp_path):
    def hold() -> None:
        bpy.data.objects["flesh"].modifiers["Armature"].show_viewport = False

    rig = change(targets.target_copy, hold, tmp_path / "rig.blend")
    text = refused(refusal, rig)
    assert text.startswith("The target 'flesh' does not move while 'elbow' does, by ")
    assert text.endswith(" mm; look whether its modifiers are on and its cache is that of this action, or choose "
                         "another target.")  # fmt: skip


def test_a_hidden_target_is_refused(refusal, tmp_path):
    def hide() -> None:
        bpy.data.objects["flesh"].hide_viewport = True

    rig = change(targets.target_copy, hide, tmp_path / "rig.blend")
    assert refused(refusal, rig) == (
        "The target 'flesh' is hidden, so Blender does not evaluate it; show it in the viewport."
    )


def test_random_poses_of_a_cache_are_refused(refusal, tmp_path):
    rig = built(targets.target_pc2, tmp_path / "rig.blend")
    assert refused(refusal, rig, "--poses", 5) == (
        "The target 'flesh' follows frames (the modifier 'Cache' of 'flesh'), so it cannot show random poses; record "
        "0 random poses, and the action that it was made with."
    )


def test_mirrored_frames_of_a_cache_are_refused(refusal, tmp_path):
    rig = built(targets.target_pc2, tmp_path / "rig.blend")
    assert refused(refusal, rig, "--mirror").startswith(
        f"The target 'flesh' shows the frames of '{ACTION}' as they are, and not mirrored"
    )


def test_settling_and_pre_roll_without_a_simulation_are_refused(refusal, tmp_path):
    rig = built(targets.target_pc2, tmp_path / "rig.blend")
    assert refused(refusal, rig, "--poses", 0, "--settle-frames", 5) == (
        "The target 'flesh' cannot settle: the modifier 'Cache' of 'flesh' has a fixed range of frames; leave settling "
        "out."
    )
    assert refused(refusal, rig, "--pre-roll", 5).startswith("The target 'flesh' is no simulation, so there is nothing")
    rig = built(targets.target_copy, tmp_path / "copy.blend")
    assert "cannot settle: it follows the pose at once;" in refused(refusal, rig, "--settle-frames", 5)


def test_a_target_for_several_meshes_is_refused(refusal, tmp_path):
    rig = built(targets.target_copy, tmp_path / "rig.blend")
    assert refusal("record", rig, tmp_path / "out", "--all", "--learn-from", "flesh").startswith(
        "A target belongs to one mesh; record each mesh by itself"
    )
