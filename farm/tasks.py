# SPDX-License-Identifier: GPL-3.0-or-later
"""The task graph of a plan: verbs, their files and their dependencies.

    influences → record 1 … N → merge → train 0 → evaluate 0 → refine 1 → train 1 → evaluate 1 → … → bind

for each character, and from train 0 on for each of its meshes. A round that is not needed, because the goal is met,
ends at once. The graph is the same for all engines: a task is run by its name, wherever the plan and its files are.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from .characters import Character, Farm, Plan, folder_of_mesh

INFLUENCES, RECORD, MERGE, TRAIN, EVALUATE, REFINE, BIND = KINDS = (
    *("influences", "record", "merge", "train", "evaluate", "refine", "bind"),
)
RECORDING, EVALUATION, PICTURE = "recording", "evaluation.json", "heat_map.png"
REPORT = ("report.json", "report.html")
CHECKPOINT = ".checkpoint.npz"
PICTURE_POSES = 20


@dataclass(frozen=True)
class Round:
    """Condition of a round: it is skipped where the previous round was skipped or met the goal.

    Attributes:
        evaluate: name of the task that measured the model of the round before.
        train: name of the task that trained it, whose report says whether more poses help.
        goal_mm: what the error has to be within.
    """

    evaluate: str
    train: str
    goal_mm: float


@dataclass(frozen=True)
class Task:
    """Verbs in their own processes, whose files are in the folder of the task.

    Attributes:
        name: "hero/record-2"; parts of the path of its folder below `work`.
        kind: one of `KINDS`.
        character: its name.
        folder: of its files, absolute.
        verbs: command lines of the verbs, one after the other; where no Blender is needed as well.
        outputs: names in the folder that are there when it is done.
        after: names of the tasks that have to be done first.
        files: files from outside that it reads, absolute.
        copies: what is copied first, from the outputs of the tasks before into the folder of this one.
        publishes: what is copied last, from the folder to its place outside: (name in the folder, absolute path).
        round: of a task in a round after the first.
        choices: of `bind`: for each model that is bound, its name in the folder and the tasks (train, evaluate) of each
            round, of which the best is taken.
        poses: how many poses it evaluates or learns from; what it costs follows from that.
    """

    name: str
    kind: str
    character: str
    folder: Path
    verbs: tuple[tuple[str, ...], ...]
    outputs: tuple[str, ...]
    after: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()
    copies: tuple[tuple[Path, str], ...] = ()
    publishes: tuple[tuple[str, Path], ...] = ()
    round: Round | None = None
    choices: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = ()
    poses: int = 0

    @property
    def manifest(self) -> Path:
        """Path of the manifest, written when the task is done."""
        return self.folder.with_name(f"{self.folder.name}.json")

    @property
    def log(self) -> Path:
        """Path of the output of its verbs."""
        return self.folder.with_name(f"{self.folder.name}.log")

    @property
    def lock(self) -> Path:
        """Path of the lock, held while any of its processes runs."""
        return self.folder.with_name(f"{self.folder.name}.lock")

    def to_json(self) -> dict:
        """Return the JSON of the task, with paths as strings."""
        return asdict(self, dict_factory=lambda items: {key: _to_plain(value) for key, value in items})


def _to_plain(value: object) -> object:
    if isinstance(value, Path):
        return str(value)
    return [_to_plain(one) for one in value] if isinstance(value, tuple) else value


def make_tasks(plan: Plan) -> dict[str, Task]:
    """Make the tasks of a plan by name, in an order that respects their dependencies."""
    tasks: dict[str, Task] = {}
    for character in plan.characters:
        for task in _TaskBuilder(plan.farm, character).build_all():
            tasks[task.name] = task
    return tasks


class _TaskBuilder:
    """Builds the tasks of one character."""

    def __init__(self, farm: Farm, character: Character):
        self._farm, self._character = farm, character
        self._several = len(character.objects) > 1
        self._files = (character.rig, *character.depends)

    def build_all(self) -> Iterable[Task]:
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
        for name in character.objects if self._several else (character.objects or ("",)):
            rounds = list(self._make_rounds(name, merge))
            yield from (task for tasks in rounds for task in tasks)
            rounds_by_mesh.append((name, [(tasks[-2], tasks[-1]) for tasks in rounds]))
        yield self._make_bind(rounds_by_mesh)

    def _record_verb(self, *options: str) -> tuple[str, ...]:
        character = self._character
        lists = {
            "--object": character.objects,
            "--action": character.actions,
            "--strip": character.strips,
            "--sample": character.sample,
        }
        lists["--control"] = character.controls
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
            *(f"{option}={value}" for option, values in lists.items() for value in values),
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
        parts = (self._character.name, *([folder_of_mesh(mesh)] if mesh and self._several else []), name)
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
        of_mesh = (f"--object={mesh}",) if mesh else ()
        recording, before, condition = merge.folder / RECORDING, (), None
        if self._several:
            recording /= folder_of_mesh(mesh)
        recording_task, refine_tasks, last_model = merge, (), None
        for index in range(1 + (character.rounds if character.goal_mm else 0)):
            if index:
                condition = Round(before[1].name, before[0].name, character.goal_mm)
                last_model = before[0].folder / model
                verb = ("record", str(character.rig), RECORDING, "--resume", "--refine", str(last_model), *of_mesh)
                options = ("--poses", str(character.refine_poses), "--seed", str(index))
                recording_task = self._make_task(
                    f"{REFINE}-{index}",
                    (*verb, *options),
                    (RECORDING,),
                    after=(*before, recording_task),
                    mesh=mesh,
                    copies=((recording, RECORDING),),
                    round=condition,
                    poses=character.refine_poses,
                )
                recording, refine_tasks = recording_task.folder / RECORDING, (recording_task,)
            checkpoint = model.removesuffix(".onnx") + CHECKPOINT
            train = self._make_task(
                f"{TRAIN}-{index}",
                ("train", str(recording), model, *_train_options(character), *(("--warm-start",) if index else ())),
                (model, checkpoint, *REPORT),
                after=(*before[:1], recording_task),
                mesh=mesh,
                files=(),
                copies=((last_model.with_name(checkpoint), checkpoint),) if index else (),
                round=condition,
                poses=character.poses + index * character.refine_poses,
            )
            evaluate_options = ("--json", EVALUATION, "--poses", str(character.evaluate_poses), *of_mesh)
            evaluate = self._make_task(
                f"{EVALUATE}-{index}",
                ("evaluate", str(character.rig), str(train.folder / model), *evaluate_options),
                (EVALUATION,),
                after=(train,),
                mesh=mesh,
                round=condition,
                poses=character.evaluate_poses,
            )
            before = (train, evaluate)
            yield (*refine_tasks, train, evaluate)

    def _model_name(self, mesh: str) -> str:
        return folder_of_mesh(mesh) if self._several else self._character.name

    def _make_bind(self, rounds_by_mesh: list[tuple[str, list[tuple[Task, Task]]]]) -> Task:
        """Make the task that binds the best model of each mesh and publishes it."""
        character, blend = self._character, f"{self._character.name}.blend"
        names = [self._model_name(mesh) for mesh, _ in rounds_by_mesh]
        model_paths = [f"models/{name}/{name}.onnx" if self._several else f"{name}.onnx" for name in names]
        model = "models" if self._several else model_paths[0]
        of_mesh = tuple(f"--object={name}" for name in character.objects) if len(character.objects) == 1 else ()
        verbs = [
            (
                "bind",
                str(character.rig),
                model,
                blend,
                *of_mesh,
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
    """Return the options of `train`."""
    options = ["--goal-mm", repr(float(character.goal_mm))] if character.goal_mm else []
    for key, value in character.train.items():
        values = value if isinstance(value, list) else [value]
        options += [f"--{key.replace('_', '-')}", *([] if value is True else map(str, values))]
    return tuple(options)
