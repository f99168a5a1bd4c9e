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
    return built(lambda: (build(), work()), path)


def flesh() -> bpy.types.Object:
    return bpy.data.objects["flesh"]


def nothing() -> None:
    pass


def add_vertices() -> None:
    flesh().data.vertices.add(3)


def turn_a_face() -> None:
    flesh().data.loops[0].vertex_index += 5
    flesh().data.update(calc_edges=True)


def hold() -> None:
    flesh().modifiers["Armature"].show_viewport = False


def hide() -> None:
    flesh().hide_viewport = True


def lose_file() -> None:
    flesh().modifiers["Cache"].filepath = "/nowhere/flesh.pc2"


LEARN_FROM_FLESH = ("--learn-from", "flesh", "--action", ACTION)
COPY, PC2 = targets.target_copy, targets.target_pc2


@pytest.mark.parametrize(
    ("build", "work", "options", "message"),
    [
        (COPY, add_vertices, (), "The target 'flesh' has 303 vertices and 'elbow' has 300; a target needs the same"),
        (COPY, turn_a_face, (), "The target 'flesh' has as many vertices as 'elbow' and other faces, so"),
        (COPY, hold, (), "The target 'flesh' does not move while 'elbow' does, by "),
        (COPY, hide, (), "The target 'flesh' is hidden, so Blender does not evaluate it"),
        (COPY, nothing, ("--learn-from", "elbow"), "'elbow' cannot be its own target"),
        (COPY, nothing, ("--learn-from", "skin"), "no mesh object 'skin' to be the target; its other mesh objects"),
        (COPY, nothing, ("--settle-frames", 5), "cannot settle: it follows the pose at once;"),
        (PC2, nothing, ("--poses", 0, "--settle-frames", 5), "'flesh' cannot settle: the modifier 'Cache' of 'flesh'"),
        (PC2, nothing, ("--pre-roll", 5), "The target 'flesh' is no simulation, so there is nothing"),
        (PC2, nothing, ("--mirror",), f"The target 'flesh' shows the frames of '{ACTION}' as they are, and not"),
        (PC2, nothing, ("--poses", 5), "(the modifier 'Cache' of 'flesh'), so it cannot show random poses; record 0"),
        (PC2, lose_file, (), "modifier 'Cache' of 'flesh' plays the file '/nowhere/flesh.pc2', which is not there"),
    ],
)
def test_a_target_is_refused(refusal, tmp_path, build, work, options, message):
    rig = change(build, work, tmp_path / "rig.blend")
    assert message in refused(refusal, rig, *options)


def refused(refusal: Refusal, rig: Path, *options: object) -> str:
    return refusal("record", rig, rig.parent / "recording", "--object", "elbow", *LEARN_FROM_FLESH, *options)


def test_faces_in_another_order_are_accepted(tmp_path):
    def reverse() -> None:
        mesh = bpy.data.objects["flesh"].data
        faces = [tuple(face.vertices)[::-1] for face in mesh.polygons][::-1]
        points = [vertex.co[:] for vertex in mesh.vertices]
        mesh.clear_geometry()
        mesh.from_pydata(points, [], faces)

    rig = change(targets.target_pc2, reverse, tmp_path / "rig.blend")
    assert len(of_flesh(rig, tmp_path / "recording").positions) >= FRAMES


@pytest.mark.parametrize("build", [targets.target_pc2, targets.target_alembic, targets.target_usd])
def test_frames_outside_a_cache_file_are_reported(build, capfd, tmp_path):
    def shift() -> None:
        for modifier in bpy.data.objects["flesh"].modifiers:
            if modifier.type == "MESH_CACHE":
                modifier.frame_start += 5
        for cache_file in bpy.data.cache_files:
            cache_file.frame_offset = 5

    rig = change(build, shift, tmp_path / "rig.blend")
    assert run("record", rig, tmp_path / "recording", "--object", "elbow", *LEARN_FROM_FLESH) == 0
    capfd.readouterr()
    assert run("check-recording", tmp_path / "recording") == 0
    assert f"(frozen-frames): The target 'flesh' stands still in 5 frames in which the rig moves: '{ACTION} 2'" in (
        capfd.readouterr().out
    )


def test_a_missing_file_of_a_cache_is_refused(capfd, tmp_path):
    def lose() -> None:
        bpy.data.cache_files[0].filepath = "/nowhere/flesh.abc"

    rig = change(targets.target_alembic, lose, tmp_path / "rig.blend")
    assert run("record", rig, tmp_path / "recording", "--object", "elbow", *LEARN_FROM_FLESH) == 1
    # Blender says something itself.
    message = "plays the file '/nowhere/flesh.abc', which is not there"
    assert message in capfd.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "recording").exists()


def test_a_target_that_plays_a_model_is_refused(refusal, elbow_files, tmp_path):
    def bind() -> None:
        from fdda_addon.runtime.binding import bind as bind_model
        from fdda_addon.scene.scene_rig import find_rig

        bind_model(find_rig("flesh"), elbow_files.model)

    rig = change(targets.target_copy, bind, tmp_path / "rig.blend")
    assert refused(refusal, rig).startswith("The target 'flesh' plays a model, so there is nothing to learn from it")


def test_a_target_for_several_meshes_is_refused(refusal, tmp_path):
    rig = built(targets.target_copy, tmp_path / "rig.blend")
    assert refusal("record", rig, tmp_path / "out", "--all", "--learn-from", "flesh").startswith(
        "A target belongs to one mesh; record each mesh by itself"
    )
