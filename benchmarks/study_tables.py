# SPDX-License-Identifier: GPL-3.0-or-later
"""Format the tables of `study.py` as Markdown."""

from collections.abc import Callable
from statistics import fmean, geometric_mean, median

FACTORS = ("units", "layers", "activation")
"""Properties of the hidden layers that the study varies."""


def format_tables(result: dict) -> str:
    """Format all tables of a study from the content of its study.json."""
    return (
        "\n\n".join((_format_errors_and_times(result), _format_effects(result), _format_learning_rates(result))) + "\n"
    )


def hidden_option(configuration: dict) -> str:
    """Format the hidden layers of a configuration as the value of `--hidden`."""
    return " ".join([str(configuration["units"])] * configuration["layers"])


def held_out_errors(configuration: dict, partition: str, statistic: str = "mean") -> list[float]:
    """Return one statistic of the held-out errors for each seed, mm."""
    return [training["partitions"][partition]["held_out"][statistic] for training in configuration["trainings"]]


def _format_errors_and_times(result: dict) -> str:
    names = result["partitions"]
    columns = [column for name in names for column in (f"{name}: mean, mm", "max")]
    rows = [["hidden layers", "activation", "learning rate", *columns, "training, s", "inference, µs", "weights"]]
    for configuration in result["configurations"]:
        trainings = configuration["trainings"]
        errors = []
        for name in names:
            errors += [
                _format_mean_and_range(held_out_errors(configuration, name), 4),
                f"{median(held_out_errors(configuration, name, 'max')):.2f}",
            ]
        rows.append(
            [
                hidden_option(configuration),
                configuration["activation"],
                f"{configuration['learning_rate']:g}",
                *errors,
                f"{median(t['seconds']['processor'] for t in trainings):.1f}",
                f"{median(configuration['inference_us']):.0f}",
                f"{median(t['parameters'] for t in trainings):,.0f}",
            ]
        )
    all_partitions = [training["partitions"] for c in result["configurations"] for training in c["trainings"]]
    truncation_cells, linear_cells = [], []
    for name in names:
        truncation_cells += [
            f"{fmean(partitions[name]['basis_left']['held_out'] for partitions in all_partitions):.4f}",
            "",
        ]
        errors = all_partitions[0][name]["held_out_linear"]
        linear_cells += [f"{errors['mean']:.4f}", f"{errors['max']:.2f}"]
    rows.append(["a network without error", "", "", *truncation_cells, "", "", ""])
    rows.append(["linear skinning", "", "", *linear_cells, "", "", ""])
    return _format_markdown_table(rows)


def _format_effects(result: dict) -> str:
    """Format the ratios of errors and times for each change of one factor.

    The ratios are over all pairs of configurations that differ only in that factor.
    """
    configurations = result["configurations"]
    measures = {f"{name}: mean error": lambda c, name=name: held_out_errors(c, name) for name in result["partitions"]}
    measures["training"] = lambda c: [training["seconds"]["processor"] for training in c["trainings"]]
    measures["inference"] = lambda c: c["inference_us"]
    rows = [["", *measures]]
    for factor in FACTORS:
        values = result["plan"]["activations" if factor == "activation" else factor]
        for value in values[1:]:
            rows.append([f"{value if factor == 'activation' else f'{value} {factor}'} instead of {values[0]}"])
            for measure in measures.values():
                rows[-1].append(_format_ratios(_ratios(configurations, factor, values[0], value, measure)))
    seed_row = ["largest / smallest of the seeds, median over the configurations"]
    for measure in measures.values():
        seed_ratios = [max(measure(c)) / min(measure(c)) for c in configurations]
        seed_row.append(f"{median(seed_ratios):.2f} (up to {max(seed_ratios):.2f})")
    return _format_markdown_table([*rows, seed_row])


def _ratios(configurations: list[dict], factor: str, base: object, value: object, measure: Callable) -> list[float]:
    """Divide the measure with `value` by the measure with `base`.

    Returns one ratio for each seed of every two configurations that differ only in `factor`.
    """
    other_factors = [other for other in FACTORS if other != factor]
    ratios = []
    for first in configurations:
        for second in configurations:
            if (
                first[factor] == base
                and second[factor] == value
                and all(first[other] == second[other] for other in other_factors)
            ):
                ratios += [b / a for a, b in zip(measure(first), measure(second), strict=True)]
    return ratios


def _format_ratios(ratios: list[float]) -> str:
    if not ratios:
        return ""
    decrease_count = sum(ratio < 1 for ratio in ratios)
    mean, minimum, maximum = (f"{value:.2f}" for value in (geometric_mean(ratios), min(ratios), max(ratios)))
    return f"{mean} ({minimum} to {maximum}), less in {decrease_count} of {len(ratios)}"


def _format_learning_rates(result: dict) -> str:
    rates = list(result["configurations"][0]["learning_rates"])
    rows = [["hidden layers", "activation", *rates]]
    for configuration in result["configurations"]:
        scores = configuration["learning_rates"]
        best = f"{configuration['learning_rate']:g}"
        cells = [f"{100 * scores[rate]:.2f} %" for rate in rates]
        rows.append(
            [
                hidden_option(configuration),
                configuration["activation"],
                *(f"**{text}**" if rate == best else text for rate, text in zip(rates, cells, strict=True)),
            ]
        )
    return _format_markdown_table(rows)


def _format_mean_and_range(values: list[float], decimal_places: int) -> str:
    """Format the mean, the minimum and the maximum."""
    return f"{fmean(values):.{decimal_places}f} ({min(values):.{decimal_places}f} to {max(values):.{decimal_places}f})"


def _format_markdown_table(rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" * len(rows[0]) + "|", *lines[1:]])
