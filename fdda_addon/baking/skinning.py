# SPDX-License-Identifier: GPL-3.0-or-later
"""Replaces the deformation of meshes by skin weights that are fitted to recordings, for game engines.

This changes the open file, so run it in a process of its own.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from ..core.errors import ModelError, RigError
from ..core.files.temporary import temporary_folder
from ..core.formats.messages import MessageType
from ..core.mathematics.metrics import ErrorStatistics, distances, error_statistics
from ..core.mathematics.skinning import LinearSkinning
from ..core.progress import Job, Progress
from ..core.recording.reader import Recording, read_recording
from ..core.rig import STATIC_JOINT, Rig, join_positions
from ..runtime.binding import unbind
from ..runtime.network import Network
from ..scene.arrays import COORDINATE_ELEMENT, write
from ..scene.mesh import rest_positions
from ..scene.scene_rig import SceneRig
from ..training.process import TrainerProcess

MAX_BLOCK_POSES = 16
"""Number of poses that are compared at once."""
MAX_REST_DIFFERENCE = 1e-4
"""Largest difference between the rest positions of mesh and recording, as a ratio of the size."""
PositionsFunction = Callable[[np.ndarray], np.ndarray]
"""Returns positions (n, V, 3), given the indices (n,) of poses."""
OWN_WEIGHTS, FITTED_WEIGHTS, MODEL = "own weights", "fitted weights", "model"


class _SkinFitProcess(TrainerProcess):
    module = "trainer.skin"
    failure_message = "The fit of skin weights failed."
    loss_advice = "no weights were fitted, try again"


@dataclass(frozen=True)
class ExportedSkin:
    """The skin weights of a mesh that were fitted to its recording.

    Attributes:
        mesh_name: name of the mesh object.
        bones: number of bones with weights.
        influences: largest number of bones per vertex.
        errors: errors by the name of the poses and by `OWN_WEIGHTS`, `FITTED_WEIGHTS` or `MODEL`.
    """

    mesh_name: str
    bones: int
    influences: int
    errors: dict[str, dict[str, ErrorStatistics]]

    def table(self) -> str:
        """Return the errors as text."""
        lines = [
            f"'{self.mesh_name}' follows {self.bones} bones by at most {self.influences} weights per vertex; mm:",
            f"  {'':<34}{'mean':>9}{'99.9 %':>9}{'max':>9}",
        ]
        for poses, statistics_by_name in self.errors.items():
            for name, values in statistics_by_name.items():
                lines.append(f"  {f'{poses}, {name}':<34}{values.mean:>9.3f}{values.p999:>9.2f}{values.max:>9.2f}")
        return "\n".join(lines)


def export_skinning(
    scene_rig: SceneRig,
    recording_path: Path,
    influences: int,
    held_out_actions: tuple[str, ...] = (),
    model: Path | None = None,
) -> Job[list[ExportedSkin]]:
    """Fit skin weights, and let the Armature modifier alone deform meshes with them, while the generator is iterated.

    Args:
        scene_rig: the recorded meshes, which lose all other modifiers and their shape keys.
        recording_path: their recording.
        influences: largest number of bones per vertex.
        held_out_actions: names of recorded actions to which nothing is fitted, so that their errors are measured.
        model: a model whose errors are measured, too.
    """
    recording = read_recording(recording_path)
    _check_rig(scene_rig, recording)
    model_positions = _model_positions(recording, Network(model)) if model else None
    with temporary_folder() as folder:
        # `trainer/skin/__main__.py` describes the content of the file.
        options = [f"--influences={influences}", *(f"--hold-out={name}" for name in held_out_actions)]
        with _SkinFitProcess([str(recording_path), str(folder / "skin.npz"), *options]) as process:
            for message in process.messages(wait=False):
                is_progress = message is not None and message.type is MessageType.PREPARING
                yield Progress(*map(message.values.get, ("stage", "done", "total"))) if is_progress else None
        with np.load(folder / "skin.npz") as arrays:
            fit = dict(arrays)
    fitted_rig = replace(recording.rig, skin_joints=fit["joints"].astype(np.int32), skin_weights=fit["weights"])
    methods = {OWN_WEIGHTS: _skinned_positions(recording, recording.rig)} if recording.rig.has_weights else {}
    methods[FITTED_WEIGHTS] = _skinned_positions(recording, fitted_rig)
    if model_positions:
        methods[MODEL] = model_positions
    poses = {"held-out poses": fit["held_out"]} | {name: fit[f"action_{name}"] for name in held_out_actions}
    errors = {
        poses_name: {name: _measure(recording, indices, method) for name, method in methods.items()}
        for poses_name, indices in poses.items()
    }
    skins = []
    for index, (mesh_object, part) in enumerate(zip(scene_rig.mesh_objects, recording.rig.mesh_slices, strict=True)):
        arrays = recording.rig.joint_names, fit["joints"][part], fit["weights"][part]
        bones = _write_skin(mesh_object, scene_rig.armature_object, *arrays)
        has_weights = part.start not in recording.rig.unweighted_vertices
        mesh_errors = {
            poses_name: {
                name: statistics[index] for name, statistics in by_name.items() if has_weights or name != OWN_WEIGHTS
            }
            for poses_name, by_name in errors.items()
        }
        skins.append(ExportedSkin(mesh_object.name, bones, influences, mesh_errors))
    return skins


def _check_rig(scene_rig: SceneRig, recording: Recording) -> None:
    armature_object, rig, mesh_objects = scene_rig.armature_object, recording.rig, scene_rig.mesh_objects
    for datablock in (*mesh_objects, *(o.data for o in mesh_objects), armature_object, armature_object.data):
        if datablock.library is not None:
            raise RigError(f"'{datablock.name}' is linked, so its weights cannot be replaced; open the file it is in.")
    is_equal = [len(o.data.vertices) for o in mesh_objects] == [mesh.vertices for mesh in rig.meshes]
    if is_equal:
        positions = join_positions([rest_positions(o.data) for o in mesh_objects], rig.meshes)
        is_equal = np.abs(positions - rig.rest_positions).max() <= MAX_REST_DIFFERENCE * rig.size
    if not is_equal or set(rig.joint_names) - {STATIC_JOINT} - set(armature_object.data.bones.keys()):
        names = " and ".join(f"'{mesh_object.name}'" for mesh_object in mesh_objects)
        raise RigError(f"The recording '{recording.path}' is not of {names} as it is now; record again.")


def _skinned_positions(recording: Recording, rig: Rig) -> PositionsFunction:
    """Return a function that gives the positions of linear skinning in poses of a recording."""
    skinning = LinearSkinning(rig)
    return lambda poses: skinning.positions(recording.pose_matrices[poses])


def _model_positions(recording: Recording, network: Network) -> PositionsFunction:
    """Return a function that gives the positions of a model in poses of a recording."""
    joints, controls = recording.rig.joint_names, [control.name for control in recording.rig.controls]
    rigs = recording.rig, network.info
    recorded, trained = ([mesh.fingerprint.rest_positions for mesh in rig.meshes] for rig in rigs)
    names = set(network.info.joint_names) - set(joints) | {c.name for c in network.info.controls} - set(controls)
    if recorded != trained or names:
        text = "is not of the recorded meshes; record all of its meshes, or leave --model out"
        raise ModelError(f"The model '{network.path}' {text}.")
    joint_indices = [joints.index(name) for name in network.info.joint_names]
    control_indices = [controls.index(control.name) for control in network.info.controls]
    return lambda poses: network.positions(
        recording.pose_matrices[poses][:, joint_indices], recording.controls[poses][:, control_indices]
    )


def _measure(recording: Recording, poses: np.ndarray, positions: PositionsFunction) -> list[ErrorStatistics]:
    """Return the errors of each mesh."""
    blocks = np.array_split(poses, -(-len(poses) // MAX_BLOCK_POSES))
    unit = recording.rig.metres_per_unit
    errors = np.concatenate([distances(positions(block), recording.positions[block], unit) for block in blocks])
    return [error_statistics(errors[:, part]) for part in recording.rig.mesh_slices]


def _write_skin(
    mesh_object: bpy.types.Object,
    armature_object: bpy.types.Object,
    joint_names: tuple[str, ...],
    joints: np.ndarray,
    weights: np.ndarray,
) -> int:
    """Let the Armature modifier alone deform a mesh; return the number of bones with weights.

    Args:
        joint_names: names of the joints.
        joints, weights: (V, I) joint indices and weights.
    """
    unbind(mesh_object)
    mesh_object.fdda.models.clear()
    positions = rest_positions(mesh_object.data)
    mesh_object.data = mesh_object.data.copy()
    mesh_object.shape_key_clear()
    write(mesh_object.data.vertices, COORDINATE_ELEMENT, np.ascontiguousarray(positions, np.float32))
    mesh_object.modifiers.clear()
    mesh_object.vertex_groups.clear()
    if animation := mesh_object.animation_data:
        for curve in [curve for curve in animation.drivers if curve.data_path.startswith("modifiers[")]:
            animation.drivers.remove(curve)
    used = np.unique(joints[weights > 0]).tolist()
    for joint in used:
        group = mesh_object.vertex_groups.new(name=joint_names[joint])
        for vertex, slot in np.argwhere((joints == joint) & (weights > 0)).tolist():
            group.add([vertex], float(weights[vertex, slot]), "REPLACE")
        bone = armature_object.data.bones[joint_names[joint]]
        # A bone of several segments would bend the mesh.
        bone.use_deform, bone.bbone_segments = True, 1
    modifier = mesh_object.modifiers.new("Armature", "ARMATURE")
    modifier.object = armature_object
    if mesh_object.parent != armature_object or mesh_object.parent_type != "OBJECT":
        # Exporters expect the armature as the parent.
        matrix = mesh_object.matrix_world.copy()
        mesh_object.parent, mesh_object.parent_type = armature_object, "OBJECT"
        mesh_object.matrix_parent_inverse = armature_object.matrix_world.inverted_safe()
        mesh_object.matrix_basis = matrix
    return len(used)
