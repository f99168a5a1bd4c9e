# SPDX-License-Identifier: GPL-3.0-or-later
"""The plan of a farm, `characters.toml`: which rigs, how they are recorded, how exact they have to be. docs/farm.md."""

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
    """The plan makes no sense."""


@dataclass(frozen=True)
class Farm:
    """What holds for all characters.

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
    """One character.

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
    """What `characters.toml` says; all paths are absolute."""

    path: Path
    farm: Farm
    characters: tuple[Character, ...]


LEAST = {
    **{"poses": 0, "seed": 0, "rounds": 0},
    **{"shards": 1, "refine_poses": 1, "evaluate_poses": 1, "threads": 1, "margin": 1},
}
MOST = {"shards": MAX_SHARDS, "rounds": MAX_ROUNDS, "threads": 1024, "retries": 10_000}
MOST |= {"spread": 10, "margin": int(MAX_MARGIN)}


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
    return _plan(path, values)


def _plan(path: Path, values: dict) -> Plan:
    known = {"farm", "defaults", "characters"}
    if unknown := sorted(set(values) - known):
        raise PlanError(f"'{path.name}' has a section [{unknown[0]}]; known are {', '.join(sorted(known))}.")
    sections = {name: values.get(name, {}) for name in known}
    for name, section in sections.items():
        if not isinstance(section, dict):
            raise PlanError(f"[{name}] in '{path.name}' is no section; write its keys below [{name}].")
    given = sections["characters"]
    if not given:
        raise PlanError(f"'{path.name}' has no characters; add a section [characters.NAME] with rig and output.")
    folder, taken = path.parent, {}
    farm = Farm(**{"work": folder / "farm", **_values(Farm, sections["farm"], "[farm]", folder)})
    characters = []
    for name, own in given.items():
        place = f"[characters.{name}]"
        if not NAME.fullmatch(name):
            raise PlanError(
                f"{place}: a character's name has only letters, digits, - and _, at most 64, and not {name!r}."
            )
        if not isinstance(own, dict):
            raise PlanError(f"{place} is no section; write rig and output below it.")
        merged = {**sections["defaults"], **own}
        if lacks := [key for key in ("rig", "output") if key not in merged]:
            raise PlanError(f"{place} lacks {' and '.join(lacks)}.")
        character = Character(name, **_values(Character, merged, place, folder))
        _check_character(character, place)
        for what in (("name", name.lower()), ("output", character.output)):
            if what in taken:
                raise PlanError(
                    f"{place} has the same {what[0]} as [characters.{taken[what]}]; give it one of its own."
                )
            taken[what] = name
        characters.append(character)
    return Plan(path, farm, tuple(characters))


def _check_character(character: Character, place: str) -> None:
    if len(set(map(folder_of_mesh, character.objects))) < len(character.objects):
        raise PlanError(f"{place}: two of the objects would have the same folder; rename one of them.")
    if not character.poses and not character.actions and not character.strips:
        raise PlanError(f"{place}: there is nothing to record; give poses or actions.")
    if character.fit_linear not in ("", "hard", "smooth"):
        raise PlanError(f"{place}: fit_linear is hard or smooth, and not {character.fit_linear!r}.")
    for key, value in character.train.items():
        if not SETTING.fullmatch(key) or key in ("messages", "warm_start", "goal_mm"):
            raise PlanError(
                f"{place}: train cannot have {key!r}; it takes settings of train, and goal_mm stands beside it."
            )
        values = value if isinstance(value, list) else [value]
        if not values or not all(isinstance(one, int | float | str) for one in values):
            raise PlanError(f"{place}: train.{key} is {value!r}; give a number, a text, or a list of them.")
        if isinstance(value, bool) and not value:
            raise PlanError(f"{place}: train.{key} is false; leave it out.")


def _values(kind: type, given: dict, place: str, folder: Path) -> dict:
    """Values for the fields of a dataclass, checked against their types."""
    types = {each.name: each.type for each in fields(kind) if each.name != "name"}
    found = {}
    for key, value in given.items():
        if key not in types:
            raise PlanError(f"{place} has the key {key!r}; known are {', '.join(sorted(types))}.")
        found[key] = _value(key, value, types[key], place, folder)
    return found


def _value(key: str, value: Any, kind: Any, place: str, folder: Path) -> Any:
    if kind in (tuple[str, ...], tuple[Path, ...]):
        if not isinstance(value, list):
            raise PlanError(f'{place}: {key} is a list of texts, such as ["a"], and not {value!r}.')
        return tuple(_value(key, one, kind.__args__[0], place, folder) for one in value)
    if kind is Path:
        return (folder / _text(key, value, place)).absolute()
    if kind is str:
        return _text(key, value, place)
    if kind is bool or kind == dict[str, Any]:
        wanted = bool if kind is bool else dict
        if not isinstance(value, wanted):
            raise PlanError(
                f"{place}: {key} is {'true or false' if wanted is bool else 'a section'}, and not {value!r}."
            )
        return value
    is_whole = kind in (int, int | None)
    if isinstance(value, bool) or not isinstance(value, int if is_whole else int | float) or not math.isfinite(value):
        raise PlanError(f"{place}: {key} is a {'whole ' if is_whole else ''}number, and not {value!r}.")
    low, high = LEAST.get(key, 0), MOST.get(key, 10**9)
    if not low <= value <= high:
        raise PlanError(f"{place}: {key} is from {low:,} to {high:,}, and not {value!r}.")
    return value


def _text(key: str, value: Any, place: str) -> str:
    if not isinstance(value, str) or "\0" in value:
        raise PlanError(f"{place}: {key} is a text, and not {value!r}.")
    return value


def folder_of_mesh(name: str) -> str:
    """The folder that `record` gives the recording of one of several meshes: `bpy.path.clean_name` without Blender."""
    return re.sub(r"(?![A-Za-z0-9-])[\x00-\xfe]", "_", name)
