# SPDX-License-Identifier: GPL-3.0-or-later
"""Draw the layers of the code and the states of a character for docs/development.md again: `make map`.

    python docs/pictures/make_diagrams.py docs/development.md

With - as the page, it reads the standard input and writes to the standard output. The diagrams are text that GitHub and
GitLab draw (Mermaid).
"""

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from fdda_addon.runtime.transitions import SHOWS_MODEL, TABLE, Event, State
from tests.contract.layers import LAYERS

GROUP = "MODEL_SHOWN"
"""Name of the box around the states that show the model."""


def state_diagram() -> str:
    """Return the diagram: an arrow for each pair of states, with the names of its events.

    What all states of the box do is one arrow that starts at the box. Events that change nothing are not drawn.
    """
    arrows: dict[tuple[str, str], list[str]] = {}
    for event in Event:
        common_states = {TABLE[state][event].state if event in TABLE[state] else None for state in SHOWS_MODEL}
        is_common = len(common_states) == 1 and not common_states & {None, *SHOWS_MODEL}
        keeps_states = all(event in TABLE[state] and TABLE[state][event].state == state for state in SHOWS_MODEL)
        for state, row in TABLE.items():
            if event not in row or (row[event].state == state and not row[event].effects):
                continue
            is_in_group = state in SHOWS_MODEL and (is_common or keeps_states)
            start = GROUP if is_in_group else state.name
            end = GROUP if is_in_group and keeps_states else row[event].state.name
            events = arrows.setdefault((start, end), [])
            if event.name not in events:
                events.append(event.name)
    lines = ["```mermaid", "stateDiagram-v2", "    [*] --> UNBOUND", f"    state {GROUP} {{"]
    lines += [f"        {state.name}" for state in State if state in SHOWS_MODEL]
    lines.append("    }")
    lines += [f"    {start} --> {end}: {', '.join(events)}" for (start, end), events in arrows.items()]
    return "\n".join([*lines, "```"]) + "\n"


def layer_diagram() -> str:
    """Return the diagram: a box for each layer, and the trainer beside them."""
    lines = ["```mermaid", "flowchart TD"]
    lines += [f'    layer{index}["{"<br>".join(layer)}"]' for index, layer in enumerate(LAYERS)]
    lines.append(f"    {' --> '.join(f'layer{index}' for index in range(len(LAYERS)))}")
    (training,) = (index for index, layer in enumerate(LAYERS) if "training" in layer)
    lines += [f"    layer{training} -. starts .-> trainer --> layer{LAYERS.index(('core',))}", "```"]
    return "\n".join(lines) + "\n"


def with_diagrams(page: str) -> str:
    """Return a page with the current diagrams.

    Raises:
        ValueError: the page lacks a diagram.
    """
    for diagram in (layer_diagram(), state_diagram()):
        start = "\n".join(diagram.splitlines()[:2])
        page, count = re.subn(rf"{start}\n.*?```\n", lambda _, text=diagram: text, page, count=1, flags=re.DOTALL)
        if not count:
            raise ValueError(f"the page lacks a diagram that begins with {start!r}")
    return page


if __name__ == "__main__":
    if sys.argv[1] == "-":
        sys.stdout.write(with_diagrams(sys.stdin.read()))
    else:
        path = Path(sys.argv[1])
        path.write_text(with_diagrams(path.read_text(encoding="utf-8")), encoding="utf-8")
