# SPDX-License-Identifier: GPL-3.0-or-later
"""Deforming modifiers are recorded and replaced by the model; modifiers after the rig stay enabled."""

from pathlib import Path

import bpy
import numpy as np
import pytest

from blend_fixtures.characters import stacks
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.skinned import skin_recording
from fdda_addon.evaluation.run import evaluate
from fdda_addon.evaluation.settings import EvaluationSettings
from fdda_addon.recording.rig_check import check_recordable_rig
from fdda_addon.recording.run import record
from fdda_addon.rig.modifier_stack import ModifierStack, read_stack
from fdda_addon.runtime.binding import bind, unbind
from fdda_addon.scene.scene_rig import SceneRig
from fdda_addon.timing import benchmark

from ..conftest import assert_plays, evaluated_positions, pose
from ..modifiers import FEW_POSES, add_modifier_at, add_nodes_at, build_rig
from ..scene_state import assert_same_state, drain, scene_state

MOVES = 0.001
"""Smallest distance of the farthest vertex from linear skinning with any of the stacks, meters."""


def residuals(rig: SceneRig, folder: Path) -> np.ndarray:
    drain(record(rig, folder / "recording", FEW_POSES))
    skinned = skin_recording(read_recording(folder / "recording"))
    return skinned.compute_residuals(np.arange(len(skinned.rows)))


def shown(rig: SceneRig) -> list[tuple]:
    return [(m.name, m.show_viewport, m.show_render) for m in rig.mesh_object.modifiers]


@pytest.mark.parametrize("build", stacks.STACKS, ids=lambda build: build.__name__)
def test_a_deforming_stack_is_recorded_and_played(build, loose_model, tmp_path):
    rig = build_rig(build)
    assert check_recordable_rig(rig).problems == ()
    before, modifiers = scene_state(rig), shown(rig)
    assert np.linalg.norm(residuals(rig, tmp_path), axis=2).max() > MOVES
    assert_same_state(before, scene_state(rig))

    pose(angle=1.0)
    true = evaluated_positions(rig.mesh_object)
    bind(rig, loose_model)
    live = [m for m in rig.mesh_object.modifiers if m.name in read_downstream_names(rig)]
    assert len(evaluated_positions(rig.mesh_object)) == len(true)
    for modifier in live:
        modifier.show_viewport = False
    for mode in ("FDDA", "LINEAR"):
        rig.mesh_object.fdda.mode = mode
        assert len(evaluated_positions(rig.mesh_object)) == len(rig.mesh_object.data.vertices)
    rig.mesh_object.fdda.mode = "FDDA"
    assert_plays(rig.mesh_object, loose_model)
    for modifier in live:
        modifier.show_viewport = True
    unbind(rig.mesh_object)
    assert shown(rig) == modifiers
    np.testing.assert_allclose(evaluated_positions(rig.mesh_object), true, atol=1e-6)


def read_downstream_names(rig: SceneRig) -> tuple[str, ...]:
    """Return the names of the modifiers that stay on after the modifier FDDA of a bound object."""
    with_rig, rig.mesh_object.fdda.mode = rig.mesh_object.fdda.mode, "RIG"
    live = read_stack(rig.mesh_object).downstream
    rig.mesh_object.fdda.mode = with_rig
    return live


def test_modifiers_that_add_vertices_after_the_rig_use_the_output_of_the_model(loose_model):
    rig = build_rig(stacks.subdivided)
    assert read_stack(rig.mesh_object) == ModifierStack(
        ("Armature", "Mush"), (), ("Subdivision", "Thickness", "Detail"), 2
    )
    pose(angle=1.0)
    true = evaluated_positions(rig.mesh_object)
    bind(rig, loose_model)
    playing = evaluated_positions(rig.mesh_object)
    assert len(playing) == len(true) > 8 * len(rig.mesh_object.data.vertices)
    # The smoothing of this character differs slightly from the smoothing that the model has learned.
    assert np.linalg.norm(playing - true, axis=1).mean() < 0.002
    assert [m.name for m in rig.mesh_object.modifiers if m.show_viewport] == [
        "FDDA", "FDDA Undeformed", "Subdivision", "Thickness", "Detail",
    ]  # fmt: skip


def test_an_evaluation_disables_downstream_modifiers_and_restores_them(rig, elbow_files):
    settings = EvaluationSettings(poses=3, range_scales=())
    errors = drain(evaluate(rig, elbow_files.model, settings)).fdda
    rig.mesh_object.modifiers.new("Subdivision", "SUBSURF")
    before = scene_state(rig)
    assert drain(evaluate(rig, elbow_files.model, settings)).fdda == errors
    assert_same_state(before, scene_state(rig))


@pytest.mark.parametrize("is_trained", [True, False])
def test_frame_times_include_downstream_modifiers(rig, elbow_files, monkeypatch, is_trained):
    rig.mesh_object.modifiers.new("Subdivision", "SUBSURF")
    before = scene_state(rig)
    seen, time_frames = [], benchmark.time_frames

    def watch(scene: bpy.types.Scene, *arguments: object) -> list[float]:
        is_shown = scene == bpy.context.scene
        seen.append([m.name for m in rig.mesh_object.modifiers if m.show_viewport] if is_shown else None)
        return time_frames(scene, *arguments)

    monkeypatch.setattr(benchmark, "time_frames", watch)
    models = {rig.mesh_object: elbow_files.model} if is_trained else {}
    assert drain(benchmark.benchmark(rig.armature_object, 5, models)).is_estimate != is_trained
    true, linear, model = (
        [*own, "Subdivision"] for own in (["Armature", "CorrectiveSmooth"], ["Armature"], ["FDDA", "FDDA Undeformed"])
    )
    # More rounds follow while the times vary.
    rounds = len(seen) // 6
    assert seen == [true, linear, model, model, None, None] * rounds
    assert benchmark.ROUNDS <= rounds <= benchmark.MAX_ROUNDS
    assert_same_state(before, scene_state(rig))


def test_downstream_modifiers_are_restored_after_an_interrupted_recording(tmp_path):
    rig = build_rig(stacks.subdivided)
    before = scene_state(rig)
    drain(record(rig, tmp_path / "recording", FEW_POSES), stop_after=2)
    assert_same_state(before, scene_state(rig))


def test_modifiers_that_do_not_deform_are_ignored_at_any_position(loose_model, tmp_path):
    rig = build_rig(stacks.corrective_smooth)
    plain = residuals(rig, tmp_path)
    first = ("UV_WARP", "VERTEX_WEIGHT_EDIT", "DATA_TRANSFER")
    for kind in ("WEIGHTED_NORMAL", "TRIANGULATE", "PARTICLE_SYSTEM", "FLUID", "COLLISION", *first):
        rig.mesh_object.modifiers.new(kind, kind)
    for place in range(len(first)):
        rig.mesh_object.modifiers.move(len(rig.mesh_object.modifiers) - 1, place)
    (tmp_path / "again").mkdir()
    assert read_stack(rig.mesh_object).replaced == ("Armature", "Mush")
    np.testing.assert_allclose(residuals(rig, tmp_path / "again"), plain, atol=1e-6)
    bind(rig, loose_model)
    assert {m.name for m in rig.mesh_object.modifiers if not m.show_viewport} == {"Armature", "Mush"}
    assert_plays(rig.mesh_object, loose_model)


def test_a_render_only_modifier_between_replaced_ones_is_disabled_while_a_model_renders(loose_model):
    rig = build_rig(stacks.corrective_smooth)
    rig.mesh_object.modifiers.new("Subdivision", "SUBSURF").show_viewport = False
    rig.mesh_object.modifiers.move(2, 1)
    before = shown(rig)
    bind(rig, loose_model, use_in_render=True)
    assert not rig.mesh_object.modifiers["Subdivision"].show_render
    rig.mesh_object.fdda.mode = "RIG"
    assert [state for state in shown(rig) if not state[0].startswith("FDDA")] == before


def test_a_disabled_modifier_does_not_move_the_playback_modifier(loose_model):
    rig = build_rig(stacks.subdivided)
    rig.mesh_object.modifiers.new("Cast", "CAST").show_viewport = False
    bind(rig, loose_model)
    assert rig.mesh_object.modifiers.find("FDDA") == 2


def test_the_playback_modifier_is_inserted_before_a_modifier_pinned_to_last(loose_model):
    rig = build_rig(stacks.corrective_smooth)
    last = rig.mesh_object.modifiers.new("Subdivision", "SUBSURF")
    last.use_pin_to_last = True
    bind(rig, loose_model)
    assert [m.name for m in rig.mesh_object.modifiers] == ["Armature", "Mush", "FDDA", "FDDA Undeformed", "Subdivision"]


@pytest.mark.parametrize("kind", ["BUILD", "EXPLODE", "PARTICLE_INSTANCE"])
def test_time_dependent_modifiers_that_add_vertices_after_the_rig_are_downstream(kind):
    rig = build_rig(stacks.corrective_smooth)
    add_modifier_at(2, kind)(rig.mesh_object)
    assert read_stack(rig.mesh_object).downstream == ("It",)
    assert check_recordable_rig(rig).problems == ()


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        ((), "neutral"),
        (("GeometryNodeSetShadeSmooth", "GeometryNodeStoreNamedAttribute"), "neutral"),
        (("GeometryNodeSetPosition", "GeometryNodeSetMaterial"), "replaced"),
        (("GeometryNodeTransform",), "replaced"),
        (("GeometryNodeJoinGeometry",), "replaced"),
        (("GeometryNodeTriangulate",), "live"),
        (("GeometryNodeSubdivideMesh",), "live"),
        (("GeometryNodeFlipFaces",), "live"),
        (("GeometryNodeMeshToPoints",), "live"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else value,
)
@pytest.mark.parametrize("after", ["", "SUBSURF"])
def test_geometry_nodes_are_classified_by_their_effect(kinds, expected, after):
    rig = build_rig(stacks.corrective_smooth)
    add_nodes_at(2, *kinds)(rig.mesh_object)
    if after:
        rig.mesh_object.modifiers.new("After", after)
    before = scene_state(rig)
    stack = read_stack(rig.mesh_object)
    assert stack.replaced == ("Armature", "Mush") + (("It",) if expected == "replaced" else ())
    assert stack.downstream == (("It",) if expected == "live" else ()) + (("After",) if after else ())
    assert_same_state(before, scene_state(rig))


def test_a_node_group_with_unconnected_geometry_is_downstream():
    rig = build_rig()
    add_nodes_at(1)(rig.mesh_object)
    group = rig.mesh_object.modifiers["It"].node_group
    group.links.clear()
    assert read_stack(rig.mesh_object).downstream == ("It",)


def test_nodes_that_store_the_position_attribute_are_replaced():
    rig = build_rig()
    add_nodes_at(1, "GeometryNodeStoreNamedAttribute")(rig.mesh_object)
    group = rig.mesh_object.modifiers["It"].node_group
    group.nodes["Store Named Attribute"].inputs["Name"].default_value = "position"
    assert read_stack(rig.mesh_object).replaced == ("Armature", "It")


def test_shading_nodes_after_a_subdivision_are_accepted(loose_model, tmp_path):
    """Blender adds such nodes to meshes of older files that used Auto Smooth."""
    rig = build_rig(stacks.corrective_smooth)
    rig.mesh_object.modifiers.new("Subdivision", "SUBSURF")
    add_nodes_at(3, "GeometryNodeSetShadeSmooth")(rig.mesh_object)
    rig.mesh_object.modifiers["It"].use_pin_to_last = True
    assert len(residuals(rig, tmp_path)) == FEW_POSES.poses
    bind(rig, loose_model)
    assert [m.name for m in rig.mesh_object.modifiers if m.show_viewport] == [
        "FDDA",
        "FDDA Undeformed",
        "Subdivision",
        "It",
    ]


def test_a_simulation_after_the_rig_uses_the_output_of_the_model(loose_model):
    rig = build_rig(stacks.corrective_smooth)
    add_modifier_at(2, "CLOTH", show_viewport=False)(rig.mesh_object)
    bind(rig, loose_model)
    rig.mesh_object.modifiers["It"].show_viewport = True
    for frame in range(1, 5):
        bpy.context.scene.frame_set(frame)
    falling = evaluated_positions(rig.mesh_object)
    rig.mesh_object.modifiers["It"].show_viewport = False
    moved = falling - assert_plays(rig.mesh_object, loose_model)
    assert len(falling) == len(rig.mesh_object.data.vertices) and -0.2 < moved[:, 2].mean() < -0.001
