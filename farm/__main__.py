# SPDX-License-Identifier: GPL-3.0-or-later
"""The command line of the farm: `python -m fdda_addon farm characters.toml`, or `python -m farm characters.toml`.

Exit status:

    0    all characters are done
    1    a character failed; a message gives the reason
    2    wrong usage
    75   a machine was the reason, such as a full disk; run the same command again to continue
    130  interrupted by Ctrl-C
    143  ended by SIGTERM
    129  ended by SIGHUP
"""

import argparse
import contextlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from fdda_addon.core.counts import format_count
from fdda_addon.core.errors import TRY_AGAIN, FDDAError, WrongUsageError, exit_status, machine_fault_sentence
from fdda_addon.core.stop_signals import INTERRUPTED

if TYPE_CHECKING:
    from .characters import Plan
    from .task import Task

WINDOWS = "win32"


def main(arguments: list[str] | None = None) -> int:
    """Run the command line of the farm; return the exit status."""
    try:
        return _run(_parser().parse_args(arguments))
    except FDDAError as error:
        status = exit_status(error)
        print(f"Error: {error}" if status != WrongUsageError.exit_status else error, file=sys.stderr)
        return status
    except (OSError, MemoryError) as error:
        if not (text := machine_fault_sentence(error)):
            raise
        print(f"Error: {text}", file=sys.stderr)
        return TRY_AGAIN
    except KeyboardInterrupt as interrupt:
        with contextlib.suppress(OSError):  # The terminal may be closed.
            print("Interrupted; run the same command to go on.", file=sys.stderr, flush=True)
        return getattr(interrupt, "exit_status", INTERRUPTED)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("farm", description="Record, train and bind many characters on many machines.")
    parser.add_argument("plan", metavar="characters.toml", type=Path, help="the characters (docs/farm.md)")
    parser.add_argument(
        "--report",
        metavar="OUT.html",
        type=Path,
        help="write the report to this page (default: report.html beside the plan)",
    )
    parser.add_argument(
        "--only", action="append", default=[], metavar="NAME", help="run only this character; may be repeated"
    )
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="also replace files of another kind and bound files that were edited",
    )
    mode = parser.add_argument_group("instead of running all tasks").add_mutually_exclusive_group()
    mode.add_argument("--task", metavar="NAME", help="run one task; for engines that run the exported graph")
    mode.add_argument("--list", action="store_true", help="list the tasks and whether they are up to date")
    mode.add_argument("--dry-run", action="store_true", help="estimate the duration from measured times")
    mode.add_argument("--report-only", action="store_true", help="write the report of existing results")
    mode.add_argument("--openjd", metavar="OUT.json", type=Path, help="write the graph as an OpenJD job template")
    mode.add_argument("--flamenco", metavar="OUT.json", type=Path, help="write the graph as a job for Flamenco")
    cluster = parser.add_argument_group("cluster")
    cluster.add_argument(
        "--scheduler",
        default="",
        metavar="tcp://…",
        help="use a running cluster; dask: the cluster that Dask's configuration names",
    )
    cluster.add_argument(
        "--workers",
        default="",
        metavar="N",
        help="number of workers of the local cluster; with --dry-run a list such as 1,8,64",
    )
    cluster.add_argument(
        "--host", default="127.0.0.1", help="address that the local scheduler listens on (default 127.0.0.1)"
    )
    cluster.add_argument(
        "--dashboard-port",
        type=int,
        default=8787,
        metavar="N",
        help="port of the dashboard (default 8787; 0: any free port)",
    )
    return parser


def _run(options: argparse.Namespace) -> int:
    if sys.platform == WINDOWS:
        raise FDDAError(
            "The farm needs Linux or macOS, for locks that Windows does not have; on Windows use record, train and "
            "bind, or run the farm in WSL."
        )
    from fdda_addon.core.output import check_folder_writable

    from .characters import read_plan
    from .outputs import FARM_PAGE, FARM_REPORT, check_farm_outputs
    from .tasks import make_tasks

    plan = read_plan(options.plan)
    tasks = make_tasks(plan)
    if options.task:
        return _run_one_task(plan, tasks, options)
    if unknown := sorted(set(options.only) - {character.name for character in plan.characters}):
        raise WrongUsageError(f"The plan has no character '{unknown[0]}'.")
    if options.only:
        tasks = {name: task for name, task in tasks.items() if task.character in options.only}
    if options.openjd or options.flamenco:
        return _write_graph(plan, tasks, options)
    if options.dry_run:
        from .simulation import print_estimate

        return print_estimate(plan.farm, tasks, _parse_counts(options.workers))
    page = options.report or plan.path.with_name("report.html")
    report_files = [(page, FARM_PAGE), (page.with_suffix(".json"), FARM_REPORT)]
    if options.report_only:
        from .report import write_report

        check_farm_outputs(plan, tasks.values(), report_files, options.overwrite)
        write_report(plan, tasks, {}, page)
        print(f"{page}: the report")
        return 0
    if not options.list:
        check_farm_outputs(plan, tasks.values(), report_files, options.overwrite, runs_tasks=True)
        check_folder_writable(plan.farm.work)
    return _run_all_tasks(options, plan, tasks, page)


def _write_graph(plan: "Plan", tasks: dict[str, "Task"], options: argparse.Namespace) -> int:
    """Write the graph for another engine; return the exit status."""
    from .flamenco import write_job
    from .openjd import write_template
    from .outputs import JOB, TEMPLATE, check_farm_outputs

    path, kind, write = (
        (options.openjd, TEMPLATE, write_template) if options.openjd else (options.flamenco, JOB, write_job)
    )
    check_farm_outputs(plan, tasks.values(), [(path, kind)], options.overwrite)
    return write(plan, tasks, path)


def _parse_counts(text: str) -> list[int]:
    counts = [int(part) for part in (text or "1,8,64,512").split(",") if part.strip().isdecimal()]
    if not counts or min(counts) < 1 or max(counts) > 100_000:
        raise WrongUsageError("--workers is a list of numbers from 1 to 100,000, such as 1,8,64.")
    return counts


def _run_one_task(plan: "Plan", tasks: dict[str, "Task"], options: argparse.Namespace) -> int:
    """Run one task for an engine that has already run its dependencies."""
    from .outputs import check_farm_outputs
    from .run import AGAIN, SUCCESS_STATES, run_task

    name = options.task
    if name not in tasks:
        raise WrongUsageError(f"The plan has no task '{name}'; --list names them.")
    check_farm_outputs(plan, [tasks[name]], (), options.overwrite, runs_tasks=True)
    outcome = run_task(plan.farm, tasks, name, options.overwrite)
    print(f"{name}: {outcome.state}{f', {outcome.sentence}' if outcome.sentence else ''}")
    if outcome.state in SUCCESS_STATES:
        return 0
    print(f"Error: {outcome.sentence}", file=sys.stderr)
    return TRY_AGAIN if outcome.state == AGAIN else 1


def _run_all_tasks(options: argparse.Namespace, plan: "Plan", tasks: dict[str, "Task"], page: Path) -> int:
    """Run all outdated tasks on a cluster and write the report; return the exit status."""
    from fdda_addon.core.temporary import check_temporary_folder

    from .cluster import connect_cluster, count_local_workers, run_tasks_on
    from .fingerprints import InputFingerprints, outdated_tasks
    from .report import write_report
    from .run import AGAIN, FAILED, SUCCESS_STATES, Outcome

    names, unreadable = outdated_tasks(tasks, InputFingerprints(plan.farm, tasks))
    outcomes = {name: Outcome(name, FAILED, sentence) for name, sentence in unreadable.items()}
    if options.list:
        for name in tasks:
            print(f"{name}: {'to do' if name in names else 'cannot be done' if name in outcomes else 'up to date'}")
        return 0
    for outcome in outcomes.values():
        _print_outcome(outcome, len(outcomes), len(names) + len(unreadable))
    workers = _parse_counts(options.workers)[0] if options.workers else count_local_workers()
    try:
        if names:
            check_temporary_folder()
            plan.farm.work.mkdir(parents=True, exist_ok=True)
            with connect_cluster(plan.farm, options.scheduler, workers, options.host, options.dashboard_port) as client:
                print(f"{len(names)} of {len(tasks)} tasks to do; {client.dashboard_link} shows them", flush=True)
                for outcome in run_tasks_on(client, plan.farm, tasks, names, options.overwrite):
                    outcomes[outcome.task] = outcome
                    _print_outcome(outcome, len(outcomes), len(names) + len(unreadable))
    finally:
        write_report(plan, tasks, outcomes, page)
    print(f"{page}: {format_count(len(plan.characters), 'character')}")
    states = {outcome.state for outcome in outcomes.values()}
    if states <= set(SUCCESS_STATES):
        return 0
    return 1 if FAILED in states or AGAIN not in states else TRY_AGAIN


def _print_outcome(outcome, finished_count: int, total_count: int) -> None:
    seconds = f" in {outcome.seconds:.1f} s" if outcome.seconds else ""
    text = f": {outcome.sentence}" if outcome.sentence else ""
    print(f"[{finished_count}/{total_count}] {outcome.task} {outcome.state}{seconds}{text}", flush=True)


def run_program() -> NoReturn:
    """Run the command line, then end all child processes and this process."""
    if sys.platform == WINDOWS:
        sys.exit(main())
    from .stopping import run_and_end_processes

    run_and_end_processes(main)


if __name__ == "__main__":
    run_program()
