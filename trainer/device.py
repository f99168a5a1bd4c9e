# SPDX-License-Identifier: GPL-3.0-or-later
"""The device that trains: the graphics card if it can run what a training needs, else the CPU."""

import functools
import warnings
from typing import NamedTuple

import torch

CPU, GPU = "cpu", "cuda"
WARNING_NAME = "graphics-card"


class TrainingDevice(NamedTuple):
    """The device that trains.

    Attributes:
        device: its name in torch, `CPU` or `GPU`.
        card: name of the graphics card; empty if torch finds none.
        problem: why the card is not used; empty if it is used, or if torch finds none.
    """

    device: str
    card: str = ""
    problem: str = ""


@functools.cache
def choose_device() -> TrainingDevice:
    """Choose the device. A card is tried, because torch also reports cards that are too old for it or busy."""
    card = "the graphics card"
    with warnings.catch_warnings(record=True) as driver_warnings:
        warnings.simplefilter("always")
        try:
            if not torch.cuda.is_available():
                # torch warns if a card has a driver that is too old.
                problem = error_summary(driver_warnings[-1].message) if driver_warnings else ""
                return TrainingDevice(CPU, card if problem else "", problem)
            card = torch.cuda.get_device_name(0)
            matrices = torch.ones((2, 8, 8), device=GPU, requires_grad=True)
            (matrices @ matrices).square().sum().backward()
            torch.cuda.synchronize()
        except (RuntimeError, AssertionError) as error:
            return TrainingDevice(CPU, card, error_summary(error))
    return TrainingDevice(GPU, card)


def error_summary(error: BaseException | Warning) -> str:
    """Return the first sentence of an error of torch, which continues with advice for programmers."""
    first_line = str(error).strip().partition("\n")[0]
    return first_line.partition(". ")[0].rstrip(".") or type(error).__name__


def unusable_card_text(card: str, problem: str) -> str:
    """Return the text of a warning that the CPU trains in place of a graphics card."""
    return f"{card[:1].upper()}{card[1:]} cannot be used ({problem}), so the CPU trains this model, more slowly."
