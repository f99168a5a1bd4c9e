# SPDX-License-Identifier: GPL-3.0-or-later
"""Large arrays are processed in blocks, so that float64 copies of them need little memory."""

BLOCK_ELEMENTS = 1 << 22
"""Maximum number of array elements in a block."""


def block_slices(count: int, item_elements: int) -> list[slice]:
    """Divide `count` items with `item_elements` elements each into blocks; returns the slice of each block."""
    size = max(1, BLOCK_ELEMENTS // max(1, item_elements))
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]
