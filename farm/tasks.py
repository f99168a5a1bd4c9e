# SPDX-License-Identifier: GPL-3.0-or-later
"""The graph of a plan: which verbs run on which files, and what has to be there first.

    influences → record 1 … N → merge → train 0 → evaluate 0 → refine 1 → train 1 → evaluate 1 → … → bind

for each character; from train 0 on for each of its meshes. A round that is not needed, because the goal is met, ends
at once. The graph is the same for every engine: a task is run by its name, wherever the plan and its files are.
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
    """Whether a round is needed: it is not where the round before ended, or met the goal.

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
    """A piece of work: verbs in processes of their own, whose files all lie in a folder of the task.

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
        """What is written when it is done."""
        return self.folder.with_name(f"{self.folder.name}.json")

    @property
    def log(self) -> Path:
        """What its verbs printed."""
        return self.folder.with_name(f"{self.folder.name}.log")

    @property
    def lock(self) -> Path:
        """Held while it runs, by whatever process of it is still alive."""
        return self.folder.with_name(f"{self.folder.name}.lock")

    def to_json(self) -> dict:
        """All of it in plain values, paths as texts."""
        return asdict(self, dict_factory=lambda items: {key: _plain(value) for key, value in items})


def _plain(value: object) -> object:
    if isinstance(value, Path):
        return str(value)
    return [_plain(one) for one in value] if isinstance(value, tuple) else value


def make_tasks(plan: Plan) -> dict[str, Task]:
    """The tasks of a plan by their names, each after those that it needs."""
    tasks: dict[str, Task] = {}
    for character in plan.characters:
        for task in _Tasks(plan.farm, character).all():
            tasks[task.name] = task
    return tasks


class _Tasks:
    """The tasks of one character."""

    def __init__(self, farm: Farm, character: Character):
        self._farm, self._character = farm, character
        self._several = len(character.objects) > 1
        self._files = (character.rig, *character.depends)

    def all(self) -> Iterable[Task]:
        character = self._character
        influences = self._task(INFLUENCES, self._record("--detect-influences"), (RECORDING,))
        found = ("--influences", str(influences.folder / RECORDING))
        shards = [
            self._task(
                f"{RECORD}-{number}",
                self._record("--shard", f"{number}/{character.shards}", *found),
                (RECORDING,),
                after=(influences,),
                poses=character.poses // character.shards,
            )
            for number in range(1, character.shards + 1)
        ]
        merged = ("merge-recordings", *(str(shard.folder / RECORDING) for shard in shards), RECORDING)
        merge = self._task(MERGE, merged, (RECORDING,), after=shards, files=(), poses=character.poses)
        yield from (influences, *shards, merge)
        chosen = []
        for name in character.objects if self._several else (character.objects or ("",)):
            rounds = list(self._rounds(name, merge))
            yield from (task for tasks in rounds for task in tasks)
            chosen.append((name, [(tasks[-2], tasks[-1]) for tasks in rounds]))
        yield self._bind(chosen)

    def _record(self, *options: str) -> tuple[str, ...]:
        own = self._character
        lists = {"--object": own.objects, "--action": own.actions, "--strip": own.strips, "--sample": own.sample}
        lists["--control"] = own.controls
        min_vertices = (
            () if own.min_partition_vertices is None else ("--min-partition-vertices", str(own.min_partition_vertices))
        )
        return (
            *("record", str(own.rig), RECORDING, "--resume", "--poses", str(own.poses), "--seed", str(own.seed)),
            *("--spread", repr(float(own.spread)), *(("--mirror",) if own.mirror else ()), *min_vertices),
            *(("--margin", repr(float(own.margin))) if own.margin != 1 else ()),
            *(("--fit-linear", own.fit_linear) if own.fit_linear else ()),
            *(f"{option}={value}" for option, values in lists.items() for value in values),
            *options,
        )

    def _task(
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

    def _rounds(self, mesh: str, merge: Task) -> Iterable[tuple[Task, ...]]:
        """The tasks of each round of a mesh; training and evaluation are the last two of them."""
        own, model = self._character, f"{self._model_name(mesh)}.onnx"
        of_mesh = (f"--object={mesh}",) if mesh else ()
        recording, before, condition = merge.folder / RECORDING, (), None
        if self._several:
            recording /= folder_of_mesh(mesh)
        source, refined, last = merge, (), None
        for number in range(1 + (own.rounds if own.goal_mm else 0)):
            if number:
                condition = Round(before[1].name, before[0].name, own.goal_mm)
                last = before[0].folder / model
                verb = ("record", str(own.rig), RECORDING, "--resume", "--refine", str(last), *of_mesh)
                options = ("--poses", str(own.refine_poses), "--seed", str(number))
                source = self._task(
                    f"{REFINE}-{number}",
                    (*verb, *options),
                    (RECORDING,),
                    after=(*before, source),
                    mesh=mesh,
                    copies=((recording, RECORDING),),
                    round=condition,
                    poses=own.refine_poses,
                )
                recording, refined = source.folder / RECORDING, (source,)
            checkpoint = model.removesuffix(".onnx") + CHECKPOINT
            train = self._task(
                f"{TRAIN}-{number}",
                ("train", str(recording), model, *_options(own), *(("--warm-start",) if number else ())),
                (model, checkpoint, *REPORT),
                after=(*before[:1], source),
                mesh=mesh,
                files=(),
                copies=((last.with_name(checkpoint), checkpoint),) if number else (),
                round=condition,
                poses=own.poses + number * own.refine_poses,
            )
            measured = ("--json", EVALUATION, "--poses", str(own.evaluate_poses), *of_mesh)
            evaluate = self._task(
                f"{EVALUATE}-{number}",
                ("evaluate", str(own.rig), str(train.folder / model), *measured),
                (EVALUATION,),
                after=(train,),
                mesh=mesh,
                round=condition,
                poses=own.evaluate_poses,
            )
            before = (train, evaluate)
            yield (*refined, train, evaluate)

    def _model_name(self, mesh: str) -> str:
        return folder_of_mesh(mesh) if self._several else self._character.name

    def _bind(self, chosen: list[tuple[str, list[tuple[Task, Task]]]]) -> Task:
        """Bind the best model of each mesh, and put it where the plan says."""
        own, blend = self._character, f"{self._character.name}.blend"
        names = [self._model_name(mesh) for mesh, _ in chosen]
        places = [f"models/{name}/{name}.onnx" if self._several else f"{name}.onnx" for name in names]
        model = "models" if self._several else places[0]
        of_mesh = tuple(f"--object={name}" for name in own.objects) if len(own.objects) == 1 else ()
        verbs = [("bind", str(own.rig), model, blend, *of_mesh, *(("--use-in-render",) if own.use_in_render else ()))]
        pictures = []
        for (mesh, _), place in zip(chosen, places, strict=True):
            if self._farm.pictures:
                folder = str(Path(place).parent)
                drawn = (str(Path(folder, PICTURE)), str(Path(folder, f"drawn_{EVALUATION}")))
                options = ("--heatmap", drawn[0], "--json", drawn[1], "--poses", str(PICTURE_POSES))
                verbs.append(("evaluate", str(own.rig), place, *options, *((f"--object={mesh}",) if mesh else ())))
                pictures.append(drawn[0])
        besides = [str(Path(place).parent / name) for place in places for name in (*REPORT, EVALUATION)]
        outputs = (*places, *besides, *pictures, blend)
        after = [task for _, rounds in chosen for pair in rounds for task in pair]
        return self._task(
            BIND,
            tuple(verbs),
            outputs,
            after=after,
            publishes=tuple((name, own.output / name) for name in outputs),
            choices=tuple(
                (place, tuple((train.name, evaluate.name) for train, evaluate in rounds))
                for place, (_, rounds) in zip(places, chosen, strict=True)
            ),
        )


def _options(character: Character) -> tuple[str, ...]:
    """Options of `train`."""
    options = ["--goal-mm", repr(float(character.goal_mm))] if character.goal_mm else []
    for key, value in character.train.items():
        values = value if isinstance(value, list) else [value]
        options += [f"--{key.replace('_', '-')}", *([] if value is True else map(str, values))]
    return tuple(options)
