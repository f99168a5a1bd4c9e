# SPDX-License-Identifier: GPL-3.0-or-later
"""The size of the blocks in which large arrays are processed, so that float64 copies of them need little memory."""

BLOCK_ELEMENTS = 1 << 22
"""Maximum number of array elements in a block."""
