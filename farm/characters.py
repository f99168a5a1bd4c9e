# SPDX-License-Identifier: GPL-3.0-or-later
"""The plan of a farm, `characters.toml`: rigs, settings of recording and training, accuracy goals. docs/farm.md."""

import math
import re
import tomllib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from fdda_addon.core.errors import FDDAError
from fdda_addon.core.poses import MAX_MARGIN

MAX_PLAN_BYTES = 4 << 20
MAX_SHARDS, MAX_ROUNDS = 1000, 20
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
"""Names of characters are names of folders on any disk, and parts of the names of tasks."""
SETTING = re.compile(r"[a-z][a-z0-9_]*")


class PlanError(FDDAError):
    """The plan is invalid."""


@dataclass(frozen=True)
class Farm:
    """Settings of all characters.

    Attributes:
        work: folder of what tasks hand on to each other; every machine sees it under the same path.
        python: Python with the `bpy` wheel, empty for the one that runs the task.
        blender: program that runs the verbs in place of `python`, with the add-on enabled; empty for none.
        trainer_python: Python that trains, empty for the one that the add-on finds.
        threads: of one training. The result of a training depends on it, so it is fixed and not the machine's.
        gpu: trainings need a GPU and run only where there is one.
        retries: how often a task is run again that failed for a reason of the machine's.
        retry_seconds: what a worker waits before that.
        pictures: draw a heat map of each character for the report.
    """

    work: Path
    python: str = ""
    blender: str = ""
    trainer_python: str = ""
    threads: int = 1
    gpu: bool = False
    retries: int = 20
    retry_seconds: float = 10.0
    pictures: bool = True


@dataclass(frozen=True)
class Character:
    """Settings of one character.

    Attributes:
        name: of the character; letters, digits, - and _.
        rig: the .blend file.
        output: folder of the bound file, its models and their reports.
        objects: names of the mesh objects; empty for the only one of the file.
        depends: files that the rig's file links, so that a change of them is noticed.
        poses, seed, spread, margin, actions, strips, mirror, sample, controls, fit_linear, min_partition_vertices: as
            of `record`.
        shards: how many parts the poses are recorded in.
        train: settings of the training by name, as of `train`.
        goal_mm: what 99.9 % of the vertices of held-out poses are to be within; 0 for no goal.
        rounds: how often at most poses are added where the model is worst, while the goal is missed.
        refine_poses: how many each time.
        evaluate_poses: held-out poses that the error is measured on.
        use_in_render: final renders use the model too.
    """

    name: str
    rig: Path
    output: Path
    objects: tuple[str, ...] = ()
    depends: tuple[Path, ...] = ()
    poses: int = 1000
    seed: int = 0
    spread: float = 1.0
    margin: float = 1.0
    actions: tuple[str, ...] = ()
    strips: tuple[str, ...] = ()
    mirror: bool = False
    sample: tuple[str, ...] = ()
    controls: tuple[str, ...] = ()
    fit_linear: str = ""
    min_partition_vertices: int | None = None
    shards: int = 4
    train: dict[str, Any] = field(default_factory=dict, hash=False)
    goal_mm: float = 0.0
    rounds: int = 3
    refine_poses: int = 250
    evaluate_poses: int = 200
    use_in_render: bool = False


@dataclass(frozen=True)
class Plan:
    """Content of `characters.toml`, with absolute paths."""

    path: Path
    farm: Farm
    characters: tuple[Character, ...]


MIN_VALUES = {
    **{"poses": 0, "seed": 0, "rounds": 0},
    **{"shards": 1, "refine_poses": 1, "evaluate_poses": 1, "threads": 1, "margin": 1},
}
MAX_VALUES = {"shards": MAX_SHARDS, "rounds": MAX_ROUNDS, "threads": 1024, "retries": 10_000}
MAX_VALUES |= {"spread": 10, "margin": int(MAX_MARGIN)}


def read_plan(path: Path) -> Plan:
    """Read and check a plan.

    Raises:
        PlanError: it cannot be read, or says what makes no sense; names where.
    """
    path = path.absolute()
    try:
        if path.stat().st_size > MAX_PLAN_BYTES:
            raise PlanError(f"'{path}' is larger than {MAX_PLAN_BYTES >> 20} MB; it is no plan.")
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise PlanError(f"Cannot read the plan '{path}': {error.strerror}; give the path of a .toml file.") from error
    except (ValueError, RecursionError) as error:
        raise PlanError(f"The plan '{path}' is no TOML: {error}.") from error
    return _read_plan(path, values)


def _read_plan(path: Path, values: dict) -> Plan:
    section_names = {"farm", "defaults", "characters"}
    if unknown := sorted(set(values) - section_names):
        raise PlanError(f"'{path.name}' has a section [{unknown[0]}]; known are {', '.join(sorted(section_names))}.")
    sections = {name: values.get(name, {}) for name in section_names}
    for name, section in sections.items():
        if not isinstance(section, dict):
            raise PlanError(f"[{name}] in '{path.name}' is no section; write its keys below [{name}].")
    values_given = sections["characters"]
    if not values_given:
        raise PlanError(f"'{path.name}' has no characters; add a section [characters.NAME] with rig and output.")
    folder, taken = path.parent, {}
    farm = Farm(**{"work": folder / "farm", **_read_fields(Farm, sections["farm"], "[farm]", folder)})
    characters = []
    for name, own in values_given.items():
        section = f"[characters.{name}]"
        if not NAME.fullmatch(name):
            raise PlanError(
                f"{section}: a character's name has only letters, digits, - and _, at most 64, and not {name!r}."
            )
        if not isinstance(own, dict):
            raise PlanError(f"{section} is no section; write rig and output below it.")
        merged = {**sections["defaults"], **own}
        if lacks := [key for key in ("rig", "output") if key not in merged]:
            raise PlanError(f"{section} lacks {' and '.join(lacks)}.")
        character = Character(name, **_read_fields(Character, merged, section, folder))
        _check_character(character, section)
        for what in (("name", name.lower()), ("output", character.output)):
            if what in taken:
                raise PlanError(
                    f"{section} has the same {what[0]} as [characters.{taken[what]}]; give it one of its own."
                )
            taken[what] = name
        characters.append(character)
    return Plan(path, farm, tuple(characters))


def _check_character(character: Character, section: str) -> None:
    if len(set(map(folder_of_mesh, character.objects))) < len(character.objects):
        raise PlanError(f"{section}: two of the objects would have the same folder; rename one of them.")
    if not character.poses and not character.actions and not character.strips:
        raise PlanError(f"{section}: there is nothing to record; give poses or actions.")
    if character.fit_linear not in ("", "hard", "smooth"):
        raise PlanError(f"{section}: fit_linear is hard or smooth, and not {character.fit_linear!r}.")
    for key, value in character.train.items():
        if not SETTING.fullmatch(key) or key in ("messages", "warm_start", "goal_mm"):
            raise PlanError(
                f"{section}: train cannot have {key!r}; it takes settings of train, and goal_mm stands beside it."
            )
        values = value if isinstance(value, list) else [value]
        if not values or not all(isinstance(one, int | float | str) for one in values):
            raise PlanError(f"{section}: train.{key} is {value!r}; give a number, a text, or a list of them.")
        if isinstance(value, bool) and not value:
            raise PlanError(f"{section}: train.{key} is false; leave it out.")


def _read_fields(kind: type, values_given: dict, section: str, folder: Path) -> dict:
    """Read the fields of a dataclass, and check their types."""
    types = {each.name: each.type for each in fields(kind) if each.name != "name"}
    found = {}
    for key, value in values_given.items():
        if key not in types:
            raise PlanError(f"{section} has the key {key!r}; known are {', '.join(sorted(types))}.")
        found[key] = _read_value(key, value, types[key], section, folder)
    return found


def _read_value(key: str, value: Any, kind: Any, section: str, folder: Path) -> Any:
    if kind in (tuple[str, ...], tuple[Path, ...]):
        if not isinstance(value, list):
            raise PlanError(f'{section}: {key} is a list of texts, such as ["a"], and not {value!r}.')
        return tuple(_read_value(key, one, kind.__args__[0], section, folder) for one in value)
    if kind is Path:
        return (folder / _read_text(key, value, section)).absolute()
    if kind is str:
        return _read_text(key, value, section)
    if kind is bool or kind == dict[str, Any]:
        wanted = bool if kind is bool else dict
        if not isinstance(value, wanted):
            raise PlanError(
                f"{section}: {key} is {'true or false' if wanted is bool else 'a section'}, and not {value!r}."
            )
        return value
    is_whole = kind in (int, int | None)
    if isinstance(value, bool) or not isinstance(value, int if is_whole else int | float) or not math.isfinite(value):
        raise PlanError(f"{section}: {key} is a {'whole ' if is_whole else ''}number, and not {value!r}.")
    low, high = MIN_VALUES.get(key, 0), MAX_VALUES.get(key, 10**9)
    if not low <= value <= high:
        raise PlanError(f"{section}: {key} is from {low:,} to {high:,}, and not {value!r}.")
    return value


def _read_text(key: str, value: Any, section: str) -> str:
    if not isinstance(value, str) or "\0" in value:
        raise PlanError(f"{section}: {key} is a text, and not {value!r}.")
    return value


def folder_of_mesh(name: str) -> str:
    """Return the subfolder of a mesh in a recording of several meshes, as `bpy.path.clean_name` makes it."""
    return re.sub(r"(?![A-Za-z0-9-])[\x00-\xfe]", "_", name)
