# SPDX-License-Identifier: GPL-3.0-or-later
"""The sentences about differences between a rig and the rig that a model was trained for."""

from dataclasses import replace

import numpy as np
import pytest

from fdda_addon.core.controls import Control
from fdda_addon.core.rig import REST_MATRIX_TOLERANCE, Fingerprint, Joint, MeshPart, Rig, rig_differences

from .limb import JOINTS, make_rig


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


def test_the_same_rig_has_no_differences(rig):
    assert differences(rig) == []


def test_another_vertex_count_is_named(rig):
    assert differences(rig, meshes=(replace(rig.meshes[0], vertices=37),)) == ["it has 40 vertices, the mesh has 37"]


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
        (joints_with_names("a", "b", "c", "d"), [
            "the armature lacks the 4 joints 'lower', 'root', 'thumb' and 1 more",
            "it does not know the 4 joints 'a', 'b', 'c' and 1 more",
        ]),
        ((*JOINTS, Joint("tail", 0)), ["it does not know the joint 'tail'"]),
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
    digests = {
        Fingerprint.digest(array),
        Fingerprint.digest(array + 1),
        Fingerprint.digest(array.reshape(3, 4)),
        Fingerprint.digest(array.astype(np.int64)),
        Fingerprint.digest(array, array),
    }
    assert len(digests) == 5
    assert all(len(digest) == 16 and int(digest, 16) >= 0 for digest in digests)
    assert Fingerprint.digest(array.reshape(3, 4).T.copy().T) == Fingerprint.digest(array.reshape(3, 4))


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
    "one that says nothing": ({}, []),
    "rounding": (with_mush_settings(factor=0.500001), []),
    "what was animated": (with_mush_settings(scale=3.0), []),
    "a control": (with_mush_settings(iterations=None), []),
    "a setting": (with_mush_settings(factor=0.7), ["'factor' of the modifier 'Mush' was 0.5 and is 0.7"]),
    "keys": (
        with_mush_settings(factor=None), ["'factor' of the modifier 'Mush' is animated and is no control of the model"],
    ),
    "a name": ({**DEFORMATION, "modifiers": [MODIFIERS[0], MODIFIERS[1] | {"name": "Other"}]}, []),
    "order": ({**DEFORMATION, "modifiers": MODIFIERS[::-1]}, ["the modifiers are in another order"]),
    "new": (
        {**DEFORMATION, "modifiers": [NEW_MODIFIER, *MODIFIERS]}, ["it was recorded without the modifier 'New'"]
    ),
    "gone": (
        {**DEFORMATION, "modifiers": MODIFIERS[:1]},
        ["the modifier 'Mush' is gone, switched off or behind the modifier FDDA"],
    ),
    "a shape": (with_key_settings(shape="b"), ["'shape' of the shape key 'smile' differs"]),
    "a value": (with_key_settings(value=1.0), ["'value' of the shape key 'smile' was 0.0 and is 1.0"]),
    "another key": (with_additional_key(value=1.0), ["it was recorded without the shape key 'frown'"]),
    "a key that is muted": (with_additional_key(value=1.0, mute=True), []),
    "no key": ({**DEFORMATION, "shape_keys": {}}, ["the shape key 'smile' is gone"]),
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
