# SPDX-License-Identifier: GPL-3.0-or-later
"""Apply random operations of users to playing characters and compare the shown meshes with the models' output.

    python benchmarks/stress_playback.py out/stress [--evaluations 20000] [--characters 10] [--meshes 3] [--seed 0]

The operations are frame changes, subframes, poses, undo and redo, renders, modes and strengths, hidden, moved, unbound
and bound meshes, meshes bound to a model of their own, duplicates, deletions of characters and of single meshes, linked
and overridden characters, saves, and another view layer. Prints how often each operation ran, the largest difference,
and the memory that the process uses. The exit status is 1 if a character differed from the output of its model.
"""

import argparse
import os
import sys
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import bpy
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import fdda_addon  # noqa: E402
from fdda_addon.core.mathematics.skinning import LinearSkinning  # noqa: E402
from fdda_addon.rig.reading import PoseReader, read_model_rig  # noqa: E402
from fdda_addon.runtime.binding import bind, unbind  # noqa: E402
from fdda_addon.runtime.network import Network  # noqa: E402
from fdda_addon.scene.control_reader import ABSENT_INPUTS, ControlReader  # noqa: E402
from fdda_addon.scene.scene_rig import SceneRig, armature_of  # noqa: E402

MAX_DIFFERENCE_M = 1e-5
"""Largest allowed difference between the shown mesh and the output of the model, meters."""
BONES = ("upper", "lower")
OPERATION_WEIGHTS = {
    "frame": 30, "subframe": 6, "pose": 30, "pose of several": 6, "undo": 5, "redo": 4, "render": 2, "mode": 6,
    "strength": 4, "use in render": 2, "hide": 3, "move": 2, "unbind": 2, "bind": 3, "duplicate": 2, "delete": 2,
    "save": 1, "view layer": 3, "other model": 3, "link": 2,
}  # fmt: skip


@dataclass
class Outcome:
    """Results of a run.

    Attributes:
        operations: how often each operation ran.
        compared_count: number of comparisons.
        largest_difference: largest difference between a shown mesh and the model's output, meters.
        worst_case: the character and operation with the largest difference.
        memory_mb: memory of the process at regular intervals, MB.
    """

    operations: Counter = field(default_factory=Counter)
    compared_count: int = 0
    largest_difference: float = 0.0
    worst_case: str = ""
    memory_mb: list[float] = field(default_factory=list)

    def format_table(self) -> str:
        """Format one line per operation, the largest difference and the memory."""
        lines = [f"  {name:<18}{count:>8,}" for name, count in self.operations.most_common()]
        lines.append(f"  {'all':<18}{self.operations.total():>8,}")
        lines.append(
            f"{self.compared_count:,} characters compared, "
            f"largest difference {self.largest_difference:.1e} m {self.worst_case}"
        )
        lines.append("memory in MB: " + ", ".join(f"{value:.0f}" for value in self.memory_mb))
        return "\n".join(lines)


class PlaybackStress:
    """Apply random operations to the characters of the open file."""

    def __init__(
        self, first_object: bpy.types.Object, models: dict[str, Path], characters: int, folder: Path, seed: int
    ):
        """Duplicate the first character and set up the scene.

        Args:
            models: the models of single meshes by the names of the meshes, and that of the character by an empty name.
            folder: where to save the file and to render.
        """
        self._random_generator = np.random.default_rng(seed)
        self._models, self._max_characters = models, characters + 2
        # Blender does not link from the open file. The model is found beside the copy.
        self._folder, self._library = folder, bpy.data.filepath.replace(".blend", f"_{os.getpid()}.blend")
        bpy.ops.wm.save_as_mainfile(filepath=self._library, copy=True)
        self._networks, self._linear_skinning = {}, {}
        for mesh_object in _meshes_of(armature_of(first_object)):
            for model in (models[""], models.get(mesh_object.name)):
                if model is not None:
                    network = Network(model).of_mesh(mesh_object.name)
                    rig = network.linear_rig(read_model_rig(_rig_of(mesh_object), network.info))
                    self._networks[model.stem, mesh_object.name] = network
                    self._linear_skinning[model.stem, mesh_object.name] = LinearSkinning(
                        replace(rig, rest_matrices=network.info.rest_matrices)
                    )
        self._second_layer_name = bpy.context.scene.view_layers.new("second").name
        self._set_up_renders()
        for mesh_object in _meshes_of(armature_of(first_object)):
            mesh_object["place"] = mesh_object.location
        for _ in range(characters - 1):
            self._duplicate()
        # Half of the characters keep the animation; the others keep the poses that the operations set.
        for armature_object in self._armatures()[1::2]:
            armature_object.animation_data_clear()
        self.outcome = Outcome()
        bpy.ops.ed.undo_push(message="start")

    def run(self, evaluations: int) -> Outcome:
        """Run `evaluations` random operations; after each, evaluate the scene and compare all characters."""
        names, weights = list(OPERATION_WEIGHTS), np.array([*OPERATION_WEIGHTS.values()], float)
        bpy.context.view_layer.update()
        for number in range(evaluations):
            name = names[self._random_generator.choice(len(names), p=weights / weights.sum())]
            getattr(self, "_" + name.replace(" ", "_"))()
            bpy.context.view_layer.update()
            self.outcome.operations[name] += 1
            self._compare_characters(f"({name}, operation {number})")
            if number % max(1, evaluations // 8) == 0:
                self.outcome.memory_mb.append(_memory_mb())
        self.outcome.memory_mb.append(_memory_mb())
        return self.outcome

    def _characters(self) -> list[bpy.types.Object]:
        return [o for o in bpy.context.scene.objects if o.type == "MESH" and o.fdda.is_bound]

    def _armatures(self) -> list[bpy.types.Object]:
        return list(dict.fromkeys(map(armature_of, filter(_is_of_this_file, self._characters()))))

    def _random_character(self, may_be_override: bool = True) -> bpy.types.Object:
        """Return a bound mesh object that can be edited."""
        characters = [o for o in self._characters() if _is_of_this_file(o) or (may_be_override and o.override_library)]
        return characters[self._random_generator.integers(len(characters))]

    def _random_armature(self, may_be_override: bool = True) -> bpy.types.Object:
        return armature_of(self._random_character(may_be_override))

    def _compare_characters(self, after_operation: str) -> None:
        layers = bpy.context.scene.view_layers
        for depsgraph in [layer.depsgraph for layer in layers if layer == bpy.context.view_layer]:
            for mesh_object in self._characters():
                binding = mesh_object.fdda
                if binding.status and ABSENT_INPUTS not in binding.status:
                    raise AssertionError(f"{mesh_object.name} {after_operation}: {binding.status}")
                if binding.mode == "RIG" or mesh_object.hide_viewport:
                    continue
                shown_positions = _positions(mesh_object.evaluated_get(depsgraph).data)
                difference = float(np.abs(shown_positions - self._expected_positions(mesh_object, depsgraph)).max())
                self.outcome.compared_count += 1
                if difference > self.outcome.largest_difference:
                    self.outcome.largest_difference, self.outcome.worst_case = (
                        difference,
                        f"{mesh_object.name} {after_operation}",
                    )

    def _expected_positions(self, mesh_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
        key, armature_object = _model_key(mesh_object), armature_of(mesh_object)
        network = self._networks[key]
        scene_rig = _rig_of(mesh_object)
        reader = PoseReader(scene_rig, network.info.joint_names, network.info.rest_matrices)
        controls = ControlReader(scene_rig, network.info.controls).read(scene_rig, depsgraph)[None]
        pose = reader.read(mesh_object.evaluated_get(depsgraph), armature_object.evaluated_get(depsgraph))[None]
        binding = mesh_object.fdda
        strength = binding.strength if binding.mode == "FDDA" else 0.0
        model_positions = network.positions(pose, controls)[0]
        if strength == 1:
            return model_positions
        linear_positions = self._linear_skinning[key].positions(pose)[0]
        return linear_positions + np.float32(strength) * (model_positions - linear_positions)

    def _set_up_renders(self) -> None:
        scene = bpy.context.scene
        scene.render.engine = "BLENDER_WORKBENCH"
        scene.render.resolution_x = scene.render.resolution_y = 16
        camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        camera.location = (0.25, -2, 0)
        scene.collection.objects.link(camera)
        scene.camera = camera

    def _frame(self) -> None:
        bpy.context.scene.frame_set(int(self._random_generator.integers(1, 30)))

    def _subframe(self) -> None:
        bpy.context.scene.frame_set(
            int(self._random_generator.integers(1, 30)), subframe=float(self._random_generator.random())
        )

    def _pose(self) -> None:
        armature_object = self._random_armature()
        bone = armature_object.pose.bones[BONES[self._random_generator.integers(len(BONES))]]
        bone.rotation_euler = self._random_generator.uniform(-1, 1, 3)
        if self._random_generator.random() < 0.2:
            self._push_undo_step("pose")

    def _pose_of_several(self) -> None:
        for _ in range(int(self._random_generator.integers(2, 9))):
            self._pose()

    def _undo(self) -> None:
        if bpy.ops.ed.undo.poll():
            bpy.ops.ed.undo()

    def _redo(self) -> None:
        if bpy.ops.ed.redo.poll():
            bpy.ops.ed.redo()

    def _render(self) -> None:
        bpy.context.scene.render.filepath = str(self._folder / "render.png")
        bpy.ops.render.render(write_still=False)

    def _mode(self) -> None:
        self._random_character().fdda.mode = str(
            self._random_generator.choice(["FDDA", "FDDA", "FDDA", "LINEAR", "RIG"])
        )

    def _strength(self) -> None:
        self._random_character().fdda.strength = float(self._random_generator.choice([0.0, 0.5, 1.0, 1.0]))

    def _use_in_render(self) -> None:
        self._random_character().fdda.use_in_render = bool(self._random_generator.integers(2))

    def _hide(self) -> None:
        mesh_object = self._random_character()
        mesh_object.hide_viewport = not mesh_object.hide_viewport

    def _move(self) -> None:
        """Move a mesh against the others of its character, or all of a character."""
        mesh_object = self._random_character()
        moved = (mesh_object, armature_of(mesh_object))[self._random_generator.integers(2)]
        moved.location = self._random_generator.uniform(-0.2, 0.2, 3)
        if self._random_generator.integers(2):
            moved.location = moved.get("place", (0.0, 0.0, 0.0))
        # Without a step, undo would restore the location, and Blender would keep the matrix of this place.
        self._push_undo_step("move")

    def _unbind(self) -> None:
        mesh_object = self._random_character(may_be_override=False)
        if len(self._characters()) > 3 and not mesh_object.hide_viewport:
            unbind(mesh_object)
            self._push_undo_step("unbind")

    def _bind(self) -> None:
        unbound = [o for o in bpy.context.scene.objects if "place" in o and o.type == "MESH" and not o.fdda.is_bound]
        for mesh_object in unbound:
            location, mesh_object.location = mesh_object.location.copy(), mesh_object["place"]
            bpy.context.view_layer.update()
            bind(_rig_of(mesh_object), self._models[""])
            mesh_object.location = location
        if unbound:
            self._push_undo_step("bind")

    def _other_model(self) -> None:
        """Bind a mesh to a model of its own, or to the model of its character again."""
        mesh_object = self._random_character(may_be_override=False)
        stem, name = _model_key(mesh_object)
        if name in self._models and not mesh_object.hide_viewport:
            location, mesh_object.location = mesh_object.location.copy(), mesh_object["place"]
            bpy.context.view_layer.update()
            bind(_rig_of(mesh_object), self._models[name if stem == self._models[""].stem else ""])
            mesh_object.location = location
            self._push_undo_step("other model")

    def _link(self) -> None:
        """Link a character from its file, with or without a library override; or remove the linked character."""
        if linked := [o for o in bpy.context.scene.objects if not _is_of_this_file(o)]:
            bpy.data.batch_remove(linked)
        else:
            with bpy.data.libraries.load(self._library, link=True) as (source, loaded):
                loaded.objects = list(source.objects)
            objects = [o for o in loaded.objects if o.type == "ARMATURE" or o.fdda.is_bound]
            scene = bpy.context.scene
            for scene_object in objects:
                scene.collection.objects.link(scene_object)
            if self._random_generator.integers(2):
                for scene_object in objects:
                    scene_object.override_create(remap_local_usages=True)
        self._push_undo_step("link")

    def _duplicate(self) -> None:
        if len(self._armatures()) >= self._max_characters:
            return
        armature_object = self._random_armature(may_be_override=False)
        copies = {o: o.copy() for o in (armature_object, *_meshes_of(armature_object))}
        for scene_object, copy in copies.items():
            bpy.context.scene.collection.objects.link(copy)
            copy.parent = copies.get(scene_object.parent)
            for modifier in copy.modifiers:
                for name in {"object", "target"}.intersection(modifier.bl_rna.properties.keys()):
                    setattr(modifier, name, copies.get(getattr(modifier, name)))
        self._push_undo_step("duplicate")

    def _delete(self) -> None:
        """Delete a character, or one of several meshes on which no other depends."""
        if len(self._armatures()) > 3:
            mesh_object = self._random_character(may_be_override=False)
            armature_object = armature_of(mesh_object)
            meshes = _meshes_of(armature_object)
            if len(meshes) > 1 and mesh_object.fdda.model_mesh != "elbow" and self._random_generator.integers(2):
                bpy.data.objects.remove(mesh_object)
            else:
                for deleted in (*meshes, armature_object):
                    bpy.data.objects.remove(deleted)
            self._push_undo_step("delete")

    def _push_undo_step(self, message: str) -> None:
        """Push an undo step, as an operator does, so that undo includes every added or removed object."""
        bpy.context.view_layer.update()
        bpy.ops.ed.undo_push(message=message)

    def _save(self) -> None:
        bpy.ops.wm.save_as_mainfile(filepath=str(self._folder / "copy.blend"), copy=True)

    def _view_layer(self) -> None:
        layer = bpy.context.scene.view_layers[self._second_layer_name]
        layer.update()
        for mesh_object in self._characters():
            if mesh_object.fdda.mode != "RIG" and not mesh_object.hide_viewport:
                shown_positions = _positions(mesh_object.evaluated_get(layer.depsgraph).data)
                difference = float(
                    np.abs(shown_positions - self._expected_positions(mesh_object, layer.depsgraph)).max()
                )
                if difference > self.outcome.largest_difference:
                    self.outcome.largest_difference, self.outcome.worst_case = (
                        difference,
                        f"{mesh_object.name} in the other view layer",
                    )


def _is_of_this_file(scene_object: bpy.types.Object) -> bool:
    return scene_object.library is None and scene_object.override_library is None


def _model_key(mesh_object: bpy.types.Object) -> tuple[str, str]:
    """Return the name of the model file of a bound mesh object, and that of its mesh in the model."""
    return Path(mesh_object.fdda.model).stem, mesh_object.fdda.model_mesh


def _rig_of(mesh_object: bpy.types.Object) -> SceneRig:
    return SceneRig(mesh_object, armature_of(mesh_object))


def _meshes_of(armature_object: bpy.types.Object) -> list[bpy.types.Object]:
    meshes = [o for o in bpy.context.scene.objects if o.type == "MESH"]
    return [o for o in meshes if armature_of(o) == armature_object]


def _positions(mesh: bpy.types.Mesh) -> np.ndarray:
    positions = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.attributes["position"].data.foreach_get("vector", positions)
    return positions.reshape(-1, 3)


def _memory_mb() -> float:
    """Return the resident memory of the process in MB, or NaN if the system is not Linux."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6 if sys.platform == "linux" else np.nan


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--evaluations", type=int, default=20_000)
    parser.add_argument("--characters", type=int, default=10)
    parser.add_argument("--meshes", type=int, choices=(1, 3), default=1, help="number of meshes of each character")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    fdda_addon.register()
    bound, models = bind_elbow(options.folder, options.meshes)
    bpy.ops.wm.open_mainfile(filepath=str(bound))
    fdda_addon.register()
    first = bpy.data.objects["elbow"]
    start = time.perf_counter()
    stress = PlaybackStress(first, models, options.characters, options.folder, options.seed)
    outcome = stress.run(options.evaluations)
    print(f"Blender {bpy.app.version_string}, seed {options.seed}, {time.perf_counter() - start:.0f} s")
    print(outcome.format_table())
    fdda_addon.unregister()
    return int(outcome.largest_difference > MAX_DIFFERENCE_M)


def bind_elbow(folder: Path, mesh_count: int) -> tuple[Path, dict[str, Path]]:
    """Return the bound file of the elbow, with two meshes around it or none, and its models; create missing files.

    The models of single meshes have the names of the meshes, that of the character an empty name.
    """
    from blend_fixtures.characters.meshes import dressed_limb
    from blend_fixtures.elbow import build_elbow
    from fdda_addon.cli.main import main as run_verb
    from fdda_addon.scene.blend_file import save_copy

    rig, bound = folder / "elbow.blend", folder / "bound.blend"
    models = {"": folder / "character.onnx"} | {name: folder / f"{name}.onnx" for name in ("elbow", "sleeve")}
    if not bound.exists():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        fdda_addon.register()
        (build_elbow if mesh_count == 1 else dressed_limb)()
        save_copy(rig)
        verbs = [("bind", rig, models[""], bound)]
        for name, model in models.items() if mesh_count > 1 else [("", models[""])]:
            recording = folder / f"{model.stem}_recording"
            meshes = ("--object", name) if name else ("--all",)
            verbs[-1:-1] = [
                ("record", rig, recording, *meshes, "--poses", 150),
                ("train", recording, model, "--passes", 40),
            ]
        for arguments in verbs:
            if status := run_verb([str(argument) for argument in arguments], "fdda"):
                sys.exit(status)
    return bound, {name: model for name, model in models.items() if model.exists()}


if __name__ == "__main__":
    sys.exit(main())
