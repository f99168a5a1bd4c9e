# SPDX-License-Identifier: GPL-3.0-or-later
"""The rig of a recording or model: differences from another rig, key joints, controls and the dependency graph."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.controls import Control
from fdda_addon.core.mathematics.key_joints import KeyJointReport, select_joints
from fdda_addon.core.mathematics.partition import make_partitions
from fdda_addon.core.recording.reader import read_recording
from fdda_addon.core.recording.skinned import SkinnedRecording, skin_recording
from fdda_addon.core.recording.writer import RecordingExtension, RecordingWriter
from fdda_addon.core.rig import REST_MATRIX_TOLERANCE, Fingerprint, Joint, MeshPart, Rig, rig_differences
from fdda_addon.core.settings import parse_joints
from fdda_addon.rig.references import DependencyGraph, Node

from ..recordings import read_skinned, write_recording
from .limb import JOINTS, make_rig, partitions_of, random_poses, random_positions, recording_info


def differences(rig: Rig, **changes) -> list[str]:
    """Return the differences between a rig, as stored in a model, and the same rig with changed fields."""
    return rig_differences(rig.joints, rig.rest_matrices, rig.meshes, replace(rig, **changes))


def with_fingerprint(rig: Rig, **changes) -> tuple[MeshPart, ...]:
    """Return the mesh of a rig with changes of its fingerprint."""
    (mesh,) = rig.meshes
    return (replace(mesh, fingerprint=replace(mesh.fingerprint, **changes)),)


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The rig of the limb."""
    return make_rig()


def joints_with_names(*names: str) -> tuple[Joint, ...]:
    """Return the joints of the limb with other names, the first few if there are fewer names."""
    return tuple(Joint(name, joint.parent) for name, joint in zip(names, JOINTS, strict=False))


@pytest.mark.parametrize(
    ("joints", "sentences"),
    [
        (joints_with_names("root", "upper", "lower"), ["the armature lacks the joint 'thumb'"]),
        (
            joints_with_names("root", "a", "b", "thumb"),
            ["the armature lacks the 2 joints 'lower' and 'upper'", "it does not know the 2 joints 'a' and 'b'"],
        ),
        ((*JOINTS[:3], Joint("thumb", 2)), ["its joints have other parents"]),
    ],
)  # fmt: skip
def test_other_joints_are_named(rig, joints, sentences):
    rest_matrices = np.resize(rig.rest_matrices, (len(joints), 4, 4))
    assert differences(rig, joints=joints, rest_matrices=rest_matrices) == sentences


def test_another_rest_pose_of_the_armature_is_named(rig):
    rest_matrices = rig.rest_matrices.copy()
    rest_matrices[2, 0, 3] += 2 * REST_MATRIX_TOLERANCE
    assert differences(rig, rest_matrices=rest_matrices) == ["the rest pose of the armature differs"]
    rest_matrices[2, 0, 3] -= 1.5 * REST_MATRIX_TOLERANCE
    assert differences(rig, rest_matrices=rest_matrices) == [], (
        "versions of Blender compute rest matrices with different rounding"
    )


def test_rest_poses_are_compared_in_meters(rig):
    rest_matrices = rig.rest_matrices.copy()
    rest_matrices[2, 0, 3] += 50 * REST_MATRIX_TOLERANCE
    assert differences(replace(rig, metres_per_unit=0.01), rest_matrices=rest_matrices) == []
    rest_matrices[2, 0, 3] += 100 * REST_MATRIX_TOLERANCE
    assert differences(replace(rig, metres_per_unit=0.01), rest_matrices=rest_matrices) == [
        "the rest pose of the armature differs"
    ]


def test_transforms_of_meshes_are_compared_in_meters(rig):
    meshes = (rig.meshes[0], replace(rig.meshes[0], name="shirt"))

    def moved(distance_mm: float) -> tuple[MeshPart, ...]:
        matrix = np.eye(4)
        matrix[0, 3] = distance_mm
        return (meshes[0], replace(meshes[1], transform=tuple(matrix.ravel().tolist())))

    # Blender's float32 matrices move by such distances where a character in mm is 100 m away.
    assert differences(replace(rig, metres_per_unit=1e-3, meshes=moved(20)), meshes=moved(20.03)) == []
    for metres_per_unit, distance in ((1e-3, 20.2), (1, 20.0002)):
        character = replace(rig, metres_per_unit=metres_per_unit, meshes=moved(20))
        assert differences(character, meshes=moved(distance)) == ["the mesh has moved against the others ('shirt')"]


@pytest.mark.parametrize(
    ("part", "sentence"),
    [
        ("topology", "the topology of the mesh differs"),
        ("rest_positions", "the rest pose of the mesh differs"),
        ("skin_weights", "the skin weights differ"),
    ],
)
def test_other_fingerprints_are_named(rig, part, sentence):
    assert differences(rig, meshes=with_fingerprint(rig, **{part: "0"})) == [sentence]


def test_digest_depends_on_values_shapes_and_types():
    array = np.arange(12, dtype=np.int32)
    others = ((array,), (array + 1,), (array.reshape(3, 4),), (array.astype(np.int64),), (array, array))
    assert len({Fingerprint.digest(*arrays) for arrays in others}) == 5


MODIFIERS = [
    {"name": "Armature", "type": "ARMATURE", "settings": {"object": "the rig's armature", "use_vertex_groups": True}},
    {"name": "Mush", "type": "CORRECTIVE_SMOOTH", "settings": {"factor": 0.5, "iterations": 10, "scale": None}},
]

DEFORMATION = {
    "modifiers": MODIFIERS,
    "shape_keys": {"smile": {"value": 0.0, "mute": False, "shape": "a"}},
    "b_bones": {"tail": {"segments": 4, "curve": [0.0, 0.5]}},
    "drivers": {'mesh_object/modifiers["Mush"].scale[0]': "d"},
}


def with_mush_settings(**settings: object) -> dict:
    """Return the deformation with changed settings of its Corrective Smooth modifier."""
    return {
        **DEFORMATION,
        "modifiers": [MODIFIERS[0], MODIFIERS[1] | {"settings": MODIFIERS[1]["settings"] | settings}],
    }


def with_key_settings(**settings: object) -> dict:
    """Return the deformation with changed settings of its shape key."""
    return {**DEFORMATION, "shape_keys": {"smile": DEFORMATION["shape_keys"]["smile"] | settings}}


def with_additional_key(**settings: object) -> dict:
    """Return the deformation with a second shape key."""
    return {**DEFORMATION, "shape_keys": {**DEFORMATION["shape_keys"], "frown": settings}}


NEW_MODIFIER = {"name": "New", "type": "CAST", "settings": {}}

CHANGED_DEFORMATIONS = {
    "the same": (DEFORMATION, []),
    "rounding": (with_mush_settings(factor=0.500001), []),
    "what was animated": (with_mush_settings(scale=3.0), []),
    "a control": (with_mush_settings(iterations=None), []),
    "a setting": (with_mush_settings(factor=0.7), ["'factor' of the modifier 'Mush' was 0.5 and is 0.7"]),
    "keys": (
        with_mush_settings(factor=None), ["'factor' of the modifier 'Mush' is animated and is no control of the model"],
    ),
    "order": ({**DEFORMATION, "modifiers": MODIFIERS[::-1]}, ["the modifiers are in another order"]),
    "new": (
        {**DEFORMATION, "modifiers": [NEW_MODIFIER, *MODIFIERS]}, ["it was recorded without the modifier 'New'"]
    ),
    "a shape": (with_key_settings(shape="b"), ["'shape' of the shape key 'smile' differs"]),
    "another key": (with_additional_key(value=1.0), ["it was recorded without the shape key 'frown'"]),
    "a key that is muted": (with_additional_key(value=1.0, mute=True), []),
    "B-Bones": (
        {**DEFORMATION, "b_bones": {"tail": {"segments": 4, "curve": [0.0, 1.0]}, "arm": {"segments": 2}}},
        ["'curve' of the bone 'tail' differs", "the bone 'arm' was no B-Bone when it was recorded"],
    ),
    "drivers": (
        {**DEFORMATION, "drivers": dict.fromkeys([*DEFORMATION["drivers"], "mesh/a[0]"], "e")},
        ["it was recorded without the driver of 'a'", """the driver of 'modifiers["Mush"].scale' differs"""],
    ),
    "no drivers": ({**DEFORMATION, "drivers": {}}, ["""the driver of 'modifiers["Mush"].scale' is muted or gone"""]),
    "the driver of a control": (
        {**DEFORMATION, "drivers": DEFORMATION["drivers"] | {'mesh_object/modifiers["Mush"].iterations[0]': "e"}}, [],
    ),
    "much": (
        {"modifiers": [], "drivers": {}},
        ["the modifier 'Armature' is gone, switched off or behind the modifier FDDA",
         "the modifier 'Mush' is gone, switched off or behind the modifier FDDA",
         "the shape key 'smile' is gone", "2 more"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("change", CHANGED_DEFORMATIONS)
def test_other_deformations_are_named(rig, change):
    deformation, sentences = CHANGED_DEFORMATIONS[change]
    recorded_rig = replace(rig, meshes=with_fingerprint(rig, deformation=DEFORMATION))
    controls = (Control("mesh_object", 'modifiers["Mush"].iterations', 0.0, 1.0),)
    assert (
        differences(recorded_rig, meshes=with_fingerprint(rig, deformation=deformation), controls=controls) == sentences
    )


@pytest.mark.parametrize("path", ['["Socket_2"]', ".properties.inputs.Socket_2.value"], ids=["4.5", "5.2"])
@pytest.mark.parametrize("index", ["", "[2]"])
def test_an_input_of_nodes_that_is_a_control_may_differ(rig, path, index):
    def with_input(identifier):
        settings = {"Socket_2": 0.0, "Socket_3": 0.0} | {identifier: 0.5}
        deformation = {"modifiers": [{"name": "GN", "type": "NODES", "settings": settings}]}
        return with_fingerprint(rig, deformation=deformation)

    recorded_rig, controls = (
        replace(rig, meshes=with_input("none")),
        (Control("mesh_object", f'modifiers["GN"]{path}{index}', 0.0, 1.0),),
    )
    assert not differences(recorded_rig, meshes=with_input("Socket_2"), controls=controls)
    clauses = differences(recorded_rig, meshes=with_input("Socket_3"), controls=controls)
    assert clauses == ["'Socket_3' of the modifier 'GN' was 0.0 and is 0.5"]


@pytest.mark.parametrize("value", [[], {"modifiers": [{"name": "a"}]}, {"shape_keys": {"a": 3}}])
def test_a_damaged_deformation_is_refused(value):
    hashes = {"topology": "a", "rest_positions": "b", "skin_weights": "c"}
    assert Fingerprint.from_json({**hashes, "deformation": DEFORMATION}).deformation == DEFORMATION
    with pytest.raises(ValueError, match=r"fingerprint\.deformation"):
        Fingerprint.from_json({**hashes, "deformation": value})


REPORT = KeyJointReport("auto", 60, 500, 0.4, 0.5, still=("a", "b", "c", "d", "e"))


def chain_rig(*names: str, weighted: tuple[str, ...] = ("a", "b", "c", "d")) -> Rig:
    """Return a chain of joints with names; four vertices follow `weighted` joints, each with some of the next."""
    joints = tuple(Joint(name, index - 1) for index, name in enumerate(names))
    matrices = np.tile(np.eye(4, dtype=np.float32), (len(names), 1, 1))
    matrices[:, 0, 3] = np.arange(len(names))
    skin_joints = np.zeros((4, 4), np.int32)
    skin_joints[:, 0] = [names.index(name) for name in weighted]
    skin_joints[:, 1] = [names.index(name) for name in (*weighted[1:], weighted[0])]
    weights = np.tile(np.array([0.75, 0.25, 0, 0], np.float32), (4, 1))
    positions = np.arange(12, dtype=np.float32).reshape(4, 3)
    return Rig(joints, positions, matrices, skin_joints, weights, (MeshPart("mesh", 4, Fingerprint("t", "r", "s")),))


@pytest.mark.parametrize("text", ["all", "auto", "0050"])
def test_the_option_is_read(text):
    assert parse_joints(text) == text.lstrip("0")


@pytest.mark.parametrize("text", ["", "0", "1.5", "²", "1000000"])
def test_other_options_are_refused(text):
    with pytest.raises(ValueError, match=r"joints are auto, all, or a number from 1, and not "):
        parse_joints(text)


def test_weights_of_other_joints_count_for_the_nearest_ancestor():
    rig = chain_rig("a", "b", "c", "d")
    selected = select_joints(rig, (Joint("a", -1), Joint("c", 0)))
    assert selected.joint_names == ("a", "c")
    assert selected.skin_joints[:, :2].tolist() == [[0, 0], [0, 1], [1, 1], [1, 0]]
    np.testing.assert_array_equal(selected.rest_matrices, rig.rest_matrices[[0, 2]])
    assert selected.meshes[0].fingerprint.has_key_joints and not rig.meshes[0].fingerprint.has_key_joints


def test_the_fingerprint_depends_on_all_weights_but_not_on_joints_without_weights():
    joints = (Joint("a", -1), Joint("c", 0))

    def fingerprint(rig: Rig) -> str:
        return select_joints(rig, joints).meshes[0].fingerprint.skin_weights

    rig = chain_rig("a", "b", "c", "d")
    assert fingerprint(chain_rig("root", "a", "b", "x", "c", "d")) == fingerprint(rig)
    # The other slots of a vertex may have another order.
    swapped = replace(rig, skin_joints=rig.skin_joints[:, [1, 0, 2, 3]], skin_weights=rig.skin_weights[:, [1, 0, 2, 3]])
    assert fingerprint(swapped) == fingerprint(rig)
    changed = rig.skin_weights.copy()
    changed[3, :2] = 0.5
    others = [
        replace(rig, skin_weights=changed),
        chain_rig("a", "b", "c", "d", weighted=("a", "c", "b", "d")),
        chain_rig("a", "b", "c", "e", weighted=("a", "b", "c", "e")),
    ]
    assert len({fingerprint(rig), *map(fingerprint, others)}) == 4
    selected = select_joints(others[0], joints)
    recorded = select_joints(rig, joints)
    assert rig_differences(recorded.joints, recorded.rest_matrices, recorded.meshes, selected) == [
        "the skin weights differ"
    ]


def test_the_report_is_read_back_and_says_what_is_lost():
    assert KeyJointReport.from_json(REPORT.to_json()) == REPORT
    assert REPORT.sentence() == (
        "Key joints: the model reads 60 of 500 joints; in random poses the others follow from these within 0.40 mm "
        "(rms). No random pose moves 5 of the others ('a', 'b', 'c' and 2 more) relative to their parents, so the "
        "model does not show their own motion."
    )
    assert replace(REPORT, requested="600", joints=500).sentence() == (
        "Key joints: all 500 joints are read, because 600 were asked for."
    )
    assert replace(REPORT, independent=("x", "y"), still=()).sentence() == (
        "Key joints: the model reads 60 of 500 joints, but 2 of the others ('x' and 'y') move independently of these, "
        "by up to 0.40 mm (rms), and the model cannot learn that; read more joints, add their controls as inputs, or "
        "leave the choice to auto."
    )


@pytest.mark.parametrize(("key", "value"), [("still", "ab"), ("rig_joints", -1), ("requested", "none")])
def test_damaged_reports_are_refused(key, value):
    with pytest.raises((TypeError, ValueError)):
        KeyJointReport.from_json({**REPORT.to_json(), key: value})


SMILE = Control("shape_keys", 'key_blocks["Smile"].value', 0.0, 1.0)

FIST = Control("armature_object", 'pose.bones["hand.L"]["fist"]', -1.0, 1.0)

POSE_COUNT = 6


def control_values(count: int) -> np.ndarray:
    """Return (count, 2) float32 values of `SMILE` and `FIST`."""
    return np.random.default_rng(3).uniform(-1, 1, (count, 2)).astype(np.float32)


@pytest.fixture
def controlled_recording(tmp_path):
    """Folder of a recording with two controls."""
    rig = replace(make_rig(), controls=(SMILE, FIST))
    with RecordingWriter(tmp_path / "recording", rig, recording_info(POSE_COUNT)) as writer:
        writer.append(random_poses(POSE_COUNT), random_positions(POSE_COUNT), control_values(POSE_COUNT))
    return tmp_path / "recording"


def test_influences_follow_from_poses_in_which_inputs_move_alone(tmp_path):
    """Partitions are merged as the settings of the training say, and keep what influences any of their vertices."""
    rig = replace(make_rig(), controls=(SMILE, FIST))
    partitions = make_partitions(rig, {0: (1,), 1: (2,)}, {1: (1,), 3: (0,)})
    arrays = random_poses(POSE_COUNT), random_positions(POSE_COUNT), control_values(POSE_COUNT)
    write_recording(tmp_path / "r", rig, partitions, recording_info(POSE_COUNT), *arrays)
    skinned = read_skinned(tmp_path / "r", min_vertices_per_part=0)
    assert [(p.joint, p.influencing, p.controls) for p in skinned.partitions] == [
        *((0, (1,), ()), (1, (2,), (1,)), (2, (), ()), (3, (), (0,)))
    ]
    np.testing.assert_allclose(skinned.residuals, arrays[1], atol=1e-5)
    for partition in skinned.partitions:
        residuals = SkinnedRecording.compute_partition_residuals(skinned, partition)
        np.testing.assert_allclose(residuals, skinned.residuals[:, partition.vertices], atol=1e-6)
    (merged,) = read_skinned(tmp_path / "r", min_vertices_per_part=100).partitions
    assert merged.influencing == (1, 2) and merged.controls == (0, 1)
    assert read_skinned(tmp_path / "r", influence_tolerance=2.0).partitions[0].influencing == ()


def test_positions_that_stop_being_finite_are_influenced(tmp_path):
    rig, notes = make_rig(), []
    write_recording(tmp_path / "r", rig, partitions_of(rig), recording_info(6), random_poses(6), random_positions(6))
    positions = np.load(tmp_path / "r" / "positions.npy")
    first_vertex = make_partitions(rig)[3].vertices[0]
    positions[6 + 1 + 0, first_vertex] = np.nan
    np.save(tmp_path / "r" / "positions.npy", positions)
    skinned = skin_recording(read_recording(tmp_path / "r"), min_vertices_per_part=0, note=notes.append)
    assert skinned.partitions[3].influencing == (0,) and len(skinned.rows) == 6
    assert "are not finite in 1 test of its influences, as when 'root' moves from the rest pose" in notes[0]


def test_controls_are_read_back_and_appended(controlled_recording):
    with RecordingExtension(read_recording(controlled_recording), 2, "model.onnx") as extension:
        extension.append(random_poses(2), random_positions(2), control_values(2))
    read_back = read_recording(controlled_recording)
    assert read_back.rig.controls == (SMILE, FIST)
    assert np.array_equal(read_back.controls, np.concatenate([control_values(POSE_COUNT), control_values(2)]))


RIG = "rig"

PARENTS = {"hips": "", "thigh": "hips", "shin": "thigh", "foot": "shin", "toe": "foot"}


def bone(name: str) -> Node:
    return Node(RIG, bone=name)


def test_a_node_keeps_what_it_needs_directly_and_through_others():
    graph = DependencyGraph()
    graph.add(bone("hand"), bone("forearm"), bone("target"))
    graph.add(bone("forearm"), bone("shoulder"))
    graph.add(bone("finger"), bone("hand"))
    assert graph.kept([bone("hand")]) == {bone("hand"), bone("forearm"), bone("target"), bone("shoulder")}


def test_nodes_that_need_each_other_are_kept_together():
    graph = DependencyGraph()
    graph.add(bone("a"), bone("b"))
    graph.add(bone("b"), bone("a"))
    assert graph.kept([bone("b")]) == {bone("a"), bone("b")}


@pytest.mark.parametrize("member", ["foot", "shin", "thigh"])
def test_each_bone_of_a_chain_keeps_the_owner_and_its_target(member):
    """A bone in an IK chain depends on the bone below it that has the constraint."""
    graph = DependencyGraph()
    for name, parent in PARENTS.items():
        graph.add(bone(name), *([bone(parent)] if parent else []))
    graph.add(bone("foot"), bone("ik_target"))
    graph.add_chain(map(bone, ("foot", "shin", "thigh")))
    kept = graph.kept([bone(member)])
    assert kept == {bone(name) for name in ("foot", "shin", "thigh", "hips", "ik_target")}
    assert bone("ik_target") not in graph.kept([bone("hips")])
