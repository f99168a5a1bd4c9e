# SPDX-License-Identifier: GPL-3.0-or-later
"""The tables of `study.py`, as Markdown."""

from collections.abc import Callable
from statistics import fmean, geometric_mean, median

FACTORS = ("units", "layers", "activation")


def tables(result: dict) -> str:
    """All tables of a study, from what its study.json holds."""
    return "\n\n".join((_errors_and_times(result), _effects(result), _learning_rates(result))) + "\n"


def hidden(configuration: dict) -> str:
    """The hidden layers of a configuration as `--hidden` takes them."""
    return " ".join([str(configuration["units"])] * configuration["layers"])


def held_out(configuration: dict, partition: str, statistic: str = "mean") -> list[float]:
    """An error of the held-out poses for each seed, mm."""
    return [training["partitions"][partition]["held_out"][statistic] for training in configuration["trainings"]]


def _errors_and_times(result: dict) -> str:
    names = result["partitions"]
    columns = [column for name in names for column in (f"{name}: mean, mm", "max")]
    rows = [["hidden layers", "activation", "learning rate", *columns, "training, s", "inference, µs", "weights"]]
    for configuration in result["configurations"]:
        trainings = configuration["trainings"]
        errors = []
        for name in names:
            errors += [_spread(held_out(configuration, name), 4), f"{median(held_out(configuration, name, 'max')):.2f}"]
        rows.append(
            [
                hidden(configuration),
                configuration["activation"],
                f"{configuration['learning_rate']:g}",
                *errors,
                f"{median(t['seconds']['processor'] for t in trainings):.1f}",
                f"{median(configuration['inference_us']):.0f}",
                f"{median(t['parameters'] for t in trainings):,.0f}",
            ]
        )
    every = [training["partitions"] for c in result["configurations"] for training in c["trainings"]]
    left, linear = [], []
    for name in names:
        left += [f"{fmean(partitions[name]['basis_left']['held_out'] for partitions in every):.4f}", ""]
        errors = every[0][name]["held_out_linear"]
        linear += [f"{errors['mean']:.4f}", f"{errors['max']:.2f}"]
    rows.append(["a network without error", "", "", *left, "", "", ""])
    rows.append(["linear skinning", "", "", *linear, "", "", ""])
    return _markdown(rows)


def _effects(result: dict) -> str:
    """What a change of one factor multiplies errors and times by, over all pairs that differ in nothing else."""
    configurations = result["configurations"]
    measures = {f"{name}: mean error": lambda c, name=name: held_out(c, name) for name in result["partitions"]}
    measures["training"] = lambda c: [training["seconds"]["processor"] for training in c["trainings"]]
    measures["inference"] = lambda c: c["inference_us"]
    rows = [["", *measures]]
    for factor in FACTORS:
        values = result["plan"]["activations" if factor == "activation" else factor]
        for value in values[1:]:
            rows.append([f"{value if factor == 'activation' else f'{value} {factor}'} in place of {values[0]}"])
            for measure in measures.values():
                rows[-1].append(_factor(_ratios(configurations, factor, values[0], value, measure)))
    between = ["largest by smallest of the seeds, median configuration"]
    for measure in measures.values():
        spreads = [max(measure(c)) / min(measure(c)) for c in configurations]
        between.append(f"{median(spreads):.2f} (up to {max(spreads):.2f})")
    return _markdown([*rows, between])


def _ratios(configurations: list[dict], factor: str, base: object, value: object, measure: Callable) -> list[float]:
    """Measure with `value` by that with `base`, for each seed of every two configurations that differ in it alone."""
    rest = [other for other in FACTORS if other != factor]
    ratios = []
    for first in configurations:
        for second in configurations:
            if first[factor] == base and second[factor] == value and all(first[r] == second[r] for r in rest):
                ratios += [b / a for a, b in zip(measure(first), measure(second), strict=True)]
    return ratios


def _factor(ratios: list[float]) -> str:
    if not ratios:
        return ""
    lower = sum(ratio < 1 for ratio in ratios)
    mean, least, most = (f"{value:.2f}" for value in (geometric_mean(ratios), min(ratios), max(ratios)))
    return f"{mean} ({least} to {most}), less in {lower} of {len(ratios)}"


def _learning_rates(result: dict) -> str:
    rates = list(result["configurations"][0]["learning_rates"])
    rows = [["hidden layers", "activation", *rates]]
    for configuration in result["configurations"]:
        scores = configuration["learning_rates"]
        best = f"{configuration['learning_rate']:g}"
        shown = [f"{100 * scores[rate]:.2f} %" for rate in rates]
        rows.append(
            [
                hidden(configuration),
                configuration["activation"],
                *(f"**{text}**" if rate == best else text for rate, text in zip(rates, shown, strict=True)),
            ]
        )
    return _markdown(rows)


def _spread(values: list[float], places: int) -> str:
    """The mean, and the lowest and highest."""
    return f"{fmean(values):.{places}f} ({min(values):.{places}f} to {max(values):.{places}f})"


def _markdown(rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])
