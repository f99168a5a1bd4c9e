# SPDX-License-Identifier: GPL-3.0-or-later
"""Does to playing characters whatever users do, at random, and compares what Blender shows with the models' output:

    python benchmarks/stress_playback.py out/stress [--evaluations 20000] [--characters 10] [--seed 0]

Frames, subframes, poses, undo and redo, renders, modes and strengths, duplicates, deletions, saves, another view layer.
Prints how often each was done, the largest difference, and the memory that the process takes; exit status 1 where a
character showed anything else.
"""

import argparse
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
from fdda_addon.core.skinning import LinearSkinning  # noqa: E402
from fdda_addon.rig.reading import PoseReader, read_model_rig  # noqa: E402
from fdda_addon.runtime.network import Network  # noqa: E402
from fdda_addon.scene.scene_rig import SceneRig, armature_modifier  # noqa: E402

MAX_DIFFERENCE_M = 1e-5
"""Meters. What Blender shows may be so far from what the model says."""
BONES = ("upper", "lower")
OPERATION_WEIGHTS = {
    "frame": 30, "subframe": 6, "pose": 30, "pose of several": 6, "undo": 5, "redo": 4, "render": 2, "mode": 6,
    "strength": 4, "use in render": 2, "duplicate": 2, "delete": 2, "save": 1, "view layer": 3,
}  # fmt: skip


@dataclass
class Outcome:
    """What happened: how often each operation, the largest difference in meters, memory in MB at its times."""

    operations: Counter = field(default_factory=Counter)
    compared: int = 0
    largest: float = 0.0
    worst: str = ""
    memory: list[float] = field(default_factory=list)

    def table(self) -> str:
        """One line an operation, and what came of all."""
        lines = [f"  {name:<18}{count:>8,}" for name, count in self.operations.most_common()]
        lines.append(f"  {'all':<18}{self.operations.total():>8,}")
        lines.append(f"{self.compared:,} characters compared, largest difference {self.largest:.1e} m {self.worst}")
        lines.append("memory in MB: " + ", ".join(f"{value:.0f}" for value in self.memory))
        return "\n".join(lines)


class PlaybackStress:
    """Characters of the open file, and operations on them at random."""

    def __init__(self, first: bpy.types.Object, model: Path, characters: int, folder: Path, seed: int):
        """Args:
        first: a bound object; the others are copies of it.
        model: its model.
        characters: how many there are at first.
        folder: for renders and saves.
        seed: what is done depends on nothing else.
        """
        self._random = np.random.default_rng(seed)
        self._folder, self._most = folder, characters + 2
        self._first = first.name
        self._network = Network(model)
        rig = read_model_rig(SceneRig(first, armature_modifier(first).object), self._network.info)
        rest = self._network.info.rest_matrices
        self._linear = LinearSkinning(replace(self._network.linear_rig(rig), rest_matrices=rest))
        self._second = bpy.context.scene.view_layers.new("second").name
        self._set_up_renders()
        for _ in range(characters - 1):
            self._duplicate()
        for number, mesh_object in enumerate(self._characters()):
            armature_object = armature_modifier(mesh_object).object
            if number % 2:
                armature_object.animation_data_clear()
        self.outcome = Outcome()
        bpy.ops.ed.undo_push(message="start")

    def run(self, evaluations: int) -> Outcome:
        """Do so many operations, each followed by an evaluation and a comparison."""
        names, weights = list(OPERATION_WEIGHTS), np.array([*OPERATION_WEIGHTS.values()], float)
        bpy.context.view_layer.update()
        for number in range(evaluations):
            name = names[self._random.choice(len(names), p=weights / weights.sum())]
            getattr(self, "_" + name.replace(" ", "_"))()
            bpy.context.view_layer.update()
            self.outcome.operations[name] += 1
            self._compare(f"({name}, operation {number})")
            if number % max(1, evaluations // 8) == 0:
                self.outcome.memory.append(_memory_mb())
        self.outcome.memory.append(_memory_mb())
        return self.outcome

    def _characters(self) -> list[bpy.types.Object]:
        return [o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound]

    def _any(self) -> bpy.types.Object:
        found = self._characters()
        return found[self._random.integers(len(found))]

    def _compare(self, what: str) -> None:
        layers = bpy.context.scene.view_layers
        for depsgraph in [layer.depsgraph for layer in layers if layer == bpy.context.view_layer]:
            for mesh_object in self._characters():
                binding = mesh_object.fdda
                if binding.status:
                    raise AssertionError(f"{mesh_object.name} {what}: {binding.status}")
                if binding.mode == "RIG":
                    continue
                shown = _positions(mesh_object.evaluated_get(depsgraph).data)
                off = float(np.abs(shown - self._expected(mesh_object, depsgraph)).max())
                self.outcome.compared += 1
                if off > self.outcome.largest:
                    self.outcome.largest, self.outcome.worst = off, f"{mesh_object.name} {what}"

    def _expected(self, mesh_object: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> np.ndarray:
        info, armature_object = self._network.info, armature_modifier(mesh_object).object
        reader = PoseReader(SceneRig(mesh_object, armature_object), info.joint_names, info.rest_matrices)
        pose = reader.read(mesh_object.evaluated_get(depsgraph), armature_object.evaluated_get(depsgraph))[None]
        binding = mesh_object.fdda
        strength = binding.strength if binding.mode == "FDDA" else 0.0
        model = self._network.positions(pose)[0]
        if strength == 1:
            return model
        linear = self._linear.positions(pose)[0]
        return linear + np.float32(strength) * (model - linear)

    def _set_up_renders(self) -> None:
        scene = bpy.context.scene
        scene.render.engine = "BLENDER_WORKBENCH"
        scene.render.resolution_x = scene.render.resolution_y = 16
        camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        camera.location = (0.25, -2, 0)
        scene.collection.objects.link(camera)
        scene.camera = camera

    def _frame(self) -> None:
        bpy.context.scene.frame_set(int(self._random.integers(1, 30)))

    def _subframe(self) -> None:
        bpy.context.scene.frame_set(int(self._random.integers(1, 30)), subframe=float(self._random.random()))

    def _pose(self) -> None:
        armature_object = armature_modifier(self._any()).object
        bone = armature_object.pose.bones[BONES[self._random.integers(len(BONES))]]
        bone.rotation_euler = self._random.uniform(-1, 1, 3)
        if self._random.random() < 0.2:
            self._push("pose")

    def _pose_of_several(self) -> None:
        for _ in range(int(self._random.integers(2, 9))):
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
        self._any().fdda.mode = str(self._random.choice(["FDDA", "FDDA", "FDDA", "LINEAR", "RIG"]))

    def _strength(self) -> None:
        self._any().fdda.strength = float(self._random.choice([0.0, 0.5, 1.0, 1.0]))

    def _use_in_render(self) -> None:
        self._any().fdda.use_in_render = bool(self._random.integers(2))

    def _duplicate(self) -> None:
        source = self._any() if self._characters() else bpy.data.objects[self._first]
        if len(self._characters()) >= self._most:
            return
        mesh_object, armature_object = source.copy(), armature_modifier(source).object.copy()
        for copy in (mesh_object, armature_object):
            bpy.context.scene.collection.objects.link(copy)
        armature_modifier(mesh_object).object = mesh_object.parent = armature_object
        self._push("duplicate")

    def _delete(self) -> None:
        if len(self._characters()) > 3:
            mesh_object = self._any()
            armature_object = armature_modifier(mesh_object).object
            for deleted in (mesh_object, armature_object):
                bpy.data.objects.remove(deleted)
            self._push("delete")

    def _push(self, what: str) -> None:
        """As an operator does: Blender's undo must know of every object that came or went."""
        bpy.context.view_layer.update()
        bpy.ops.ed.undo_push(message=what)

    def _save(self) -> None:
        bpy.ops.wm.save_as_mainfile(filepath=str(self._folder / "copy.blend"), copy=True)

    def _view_layer(self) -> None:
        layer = bpy.context.scene.view_layers[self._second]
        layer.update()
        for mesh_object in self._characters():
            if mesh_object.fdda.mode != "RIG":
                shown = _positions(mesh_object.evaluated_get(layer.depsgraph).data)
                off = float(np.abs(shown - self._expected(mesh_object, layer.depsgraph)).max())
                if off > self.outcome.largest:
                    self.outcome.largest, self.outcome.worst = off, f"{mesh_object.name} in the other view layer"


def _positions(mesh: bpy.types.Mesh) -> np.ndarray:
    positions = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.attributes["position"].data.foreach_get("vector", positions)
    return positions.reshape(-1, 3)


def _memory_mb() -> float:
    """MB that the process holds in memory now; NaN where the system is not Linux."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6 if sys.platform == "linux" else np.nan


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--evaluations", type=int, default=20_000)
    parser.add_argument("--characters", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    fdda_addon.register()
    bound, model = _bound_elbow(options.folder)
    bpy.ops.wm.open_mainfile(filepath=str(bound))
    fdda_addon.register()
    first = next(o for o in bpy.data.objects if o.type == "MESH" and o.fdda.is_bound)
    start = time.perf_counter()
    stress = PlaybackStress(first, model, options.characters, options.folder, options.seed)
    outcome = stress.run(options.evaluations)
    print(f"Blender {bpy.app.version_string}, seed {options.seed}, {time.perf_counter() - start:.0f} s")
    print(outcome.table())
    fdda_addon.unregister()
    return int(outcome.largest > MAX_DIFFERENCE_M)


def _bound_elbow(folder: Path) -> tuple[Path, Path]:
    """The elbow's bound file and model, made where they are not there."""
    from blend_fixtures.elbow import build_elbow
    from fdda_addon.cli.main import main as run
    from fdda_addon.scene.blend_file import save_copy

    rig, recording, model, bound = (folder / n for n in ("elbow.blend", "recording", "elbow.onnx", "bound.blend"))
    if not bound.exists():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        fdda_addon.register()
        build_elbow()
        save_copy(rig)
        for arguments in (
            ("record", rig, recording, "--poses", 150),
            ("train", recording, model, "--epochs", 40),
            ("bind", rig, model, bound),
        ):
            if status := run([str(argument) for argument in arguments], "fdda"):
                sys.exit(status)
    return bound, model


if __name__ == "__main__":
    sys.exit(main())
