# SPDX-License-Identifier: GPL-3.0-or-later
"""The task graph of a plan: verbs, their files and their dependencies.

    influences → record 1 … N → merge → train 0 → evaluate 0 → refine 1 → train 1 → evaluate 1 → … → bind

for each character. The tasks from train 0 to the last evaluate exist once per mesh. The tasks of a round are skipped
when the goal is met. All engines use the same graph: they run a task by its name, on any machine with the plan.
"""

from collections.abc import Iterable
from pathlib import Path

from fdda_addon.core.joint_option import ALL
from fdda_addon.core.report import CHECKPOINT_SUFFIX

from .characters import Character, Farm, Plan, folder_of_mesh
from .task import PICTURE_POSES, REPORT, Round, Task

INFLUENCES, RECORD, MERGE, TRAIN, EVALUATE, REFINE, BIND = KINDS = (
    *("influences", "record", "merge", "train", "evaluate", "refine", "bind"),
)
RECORDING, EVALUATION, PICTURE = "recording", "evaluation.json", "heat_map.png"


def make_tasks(plan: Plan) -> dict[str, Task]:
    """Make the tasks of a plan by name, each after its dependencies."""
    tasks: dict[str, Task] = {}
    for character in plan.characters:
        for task in _TaskBuilder(plan.farm, character).build_all():
            tasks[task.name] = task
    return tasks


class _TaskBuilder:
    """Builds the tasks of one character."""

    def __init__(self, farm: Farm, character: Character):
        self._farm, self._character = farm, character
        self._has_several_meshes = len(character.objects) > 1
        self._files = (character.rig, *character.depends)

    def build_all(self) -> Iterable[Task]:
        """Yield the tasks of the character, each after its dependencies."""
        character = self._character
        influences = self._make_task(INFLUENCES, self._record_verb("--detect-influences"), (RECORDING,))
        influence_options = ("--influences", str(influences.folder / RECORDING))
        shards = [
            self._make_task(
                f"{RECORD}-{index}",
                self._record_verb("--shard", f"{index}/{character.shards}", *influence_options),
                (RECORDING,),
                after=(influences,),
                poses=character.poses // character.shards,
            )
            for index in range(1, character.shards + 1)
        ]
        merge_verb = ("merge-recordings", *(str(shard.folder / RECORDING) for shard in shards), RECORDING)
        merge = self._make_task(MERGE, merge_verb, (RECORDING,), after=shards, files=(), poses=character.poses)
        yield from (influences, *shards, merge)
        rounds_by_mesh = []
        for name in character.objects if self._has_several_meshes else (character.objects or ("",)):
            rounds = list(self._make_rounds(name, merge))
            yield from (task for tasks in rounds for task in tasks)
            rounds_by_mesh.append((name, [(tasks[-2], tasks[-1]) for tasks in rounds]))
        yield self._make_bind(rounds_by_mesh)

    def _record_verb(self, *options: str) -> tuple[str, ...]:
        """Return the command line of `record` with the settings of the character and more options."""
        character = self._character
        values_by_option = {
            "--object": character.objects,
            "--action": character.actions,
            "--strip": character.strips,
            "--sample": character.sample,
            "--control": character.controls,
        }
        min_vertices = (
            ()
            if character.min_partition_vertices is None
            else ("--min-partition-vertices", str(character.min_partition_vertices))
        )
        return (
            *(
                "record",
                str(character.rig),
                RECORDING,
                "--resume",
                "--poses",
                str(character.poses),
                "--seed",
                str(character.seed),
            ),
            *("--spread", repr(float(character.spread)), *(("--mirror",) if character.mirror else ()), *min_vertices),
            *(("--margin", repr(float(character.margin))) if character.margin != 1 else ()),
            *(("--fit-linear", character.fit_linear) if character.fit_linear else ()),
            *(("--joints", character.joints) if character.joints != ALL else ()),
            *(f"{option}={value}" for option, values in values_by_option.items() for value in values),
            *options,
        )

    def _make_task(
        self,
        name: str,
        verbs: tuple,
        outputs: tuple[str, ...],
        after: Iterable[Task] = (),
        mesh: str = "",
        files: tuple[Path, ...] | None = None,
        **values: object,
    ) -> Task:
        parts = (self._character.name, *([folder_of_mesh(mesh)] if mesh and self._has_several_meshes else []), name)
        verbs = verbs if isinstance(verbs[0], tuple) else (verbs,)
        return Task(
            "/".join(parts),
            name.rstrip("0123456789").rstrip("-"),
            self._character.name,
            self._farm.work.joinpath(*parts),
            verbs,
            outputs,
            tuple(task.name for task in after),
            self._files if files is None else files,
            **values,
        )

    def _make_rounds(self, mesh: str, merge: Task) -> Iterable[tuple[Task, ...]]:
        """Yield the tasks of each round of a mesh; the last two are training and evaluation."""
        character, model = self._character, f"{self._model_name(mesh)}.onnx"
        object_option = (f"--object={mesh}",) if mesh else ()
        recording, previous_round, condition = merge.folder / RECORDING, (), None
        if self._has_several_meshes:
            recording /= folder_of_mesh(mesh)
        recording_task, refine_tasks, last_model = merge, (), None
        for index in range(1 + (character.rounds if character.goal_mm else 0)):
            if index:
                condition = Round(previous_round[1].name, previous_round[0].name, character.goal_mm)
                last_model = previous_round[0].folder / model
                verb = (
                    "record",
                    str(character.rig),
                    RECORDING,
                    "--resume",
                    "--refine",
                    str(last_model),
                    *object_option,
                )
                options = ("--poses", str(character.refine_poses), "--seed", str(index))
                recording_task = self._make_task(
                    f"{REFINE}-{index}",
                    (*verb, *options),
                    (RECORDING,),
                    after=(*previous_round, recording_task),
                    mesh=mesh,
                    copies=((recording, RECORDING),),
                    round=condition,
                    poses=character.refine_poses,
                )
                recording, refine_tasks = recording_task.folder / RECORDING, (recording_task,)
            checkpoint = model.removesuffix(".onnx") + CHECKPOINT_SUFFIX
            train = self._make_task(
                f"{TRAIN}-{index}",
                ("train", str(recording), model, *_train_options(character), *(("--warm-start",) if index else ())),
                (model, checkpoint, *REPORT),
                after=(*previous_round[:1], recording_task),
                mesh=mesh,
                files=(),
                copies=((last_model.with_name(checkpoint), checkpoint),) if index else (),
                round=condition,
                poses=character.poses + index * character.refine_poses,
            )
            evaluate_options = ("--json", EVALUATION, "--poses", str(character.evaluate_poses), *object_option)
            evaluate = self._make_task(
                f"{EVALUATE}-{index}",
                ("evaluate", str(character.rig), str(train.folder / model), *evaluate_options),
                (EVALUATION,),
                after=(train,),
                mesh=mesh,
                round=condition,
                poses=character.evaluate_poses,
            )
            previous_round = (train, evaluate)
            yield (*refine_tasks, train, evaluate)

    def _model_name(self, mesh: str) -> str:
        return folder_of_mesh(mesh) if self._has_several_meshes else self._character.name

    def _make_bind(self, rounds_by_mesh: list[tuple[str, list[tuple[Task, Task]]]]) -> Task:
        """Make the task that binds the best model of each mesh and publishes it."""
        character, blend = self._character, f"{self._character.name}.blend"
        names = [self._model_name(mesh) for mesh, _ in rounds_by_mesh]
        model_paths = [f"models/{name}/{name}.onnx" if self._has_several_meshes else f"{name}.onnx" for name in names]
        model = "models" if self._has_several_meshes else model_paths[0]
        object_option = tuple(f"--object={name}" for name in character.objects) if len(character.objects) == 1 else ()
        verbs = [
            (
                "bind",
                str(character.rig),
                model,
                blend,
                *object_option,
                *(("--use-in-render",) if character.use_in_render else ()),
            )
        ]
        pictures = []
        for (mesh, _), model_path in zip(rounds_by_mesh, model_paths, strict=True):
            if self._farm.pictures:
                folder = str(Path(model_path).parent)
                picture_files = (str(Path(folder, PICTURE)), str(Path(folder, f"drawn_{EVALUATION}")))
                options = ("--heatmap", picture_files[0], "--json", picture_files[1], "--poses", str(PICTURE_POSES))
                verbs.append(
                    ("evaluate", str(character.rig), model_path, *options, *((f"--object={mesh}",) if mesh else ()))
                )
                pictures.append(picture_files[0])
        reports = [str(Path(model_path).parent / name) for model_path in model_paths for name in (*REPORT, EVALUATION)]
        outputs = (*model_paths, *reports, *pictures, blend)
        after = [task for _, rounds in rounds_by_mesh for pair in rounds for task in pair]
        return self._make_task(
            BIND,
            tuple(verbs),
            outputs,
            after=after,
            publishes=tuple((name, character.output / name) for name in outputs),
            choices=tuple(
                (model_path, tuple((train.name, evaluate.name) for train, evaluate in rounds))
                for model_path, (_, rounds) in zip(model_paths, rounds_by_mesh, strict=True)
            ),
        )


def _train_options(character: Character) -> tuple[str, ...]:
    """Return the command-line options of `train` from the settings of a character."""
    options = ["--goal-mm", repr(float(character.goal_mm))] if character.goal_mm else []
    for key, value in character.train.items():
        values = value if isinstance(value, list) else [value]
        options += [f"--{key.replace('_', '-')}", *([] if value is True else map(str, values))]
    return tuple(options)
