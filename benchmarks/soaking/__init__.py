# SPDX-License-Identifier: GPL-3.0-or-later
"""The parts of `benchmarks/soak.py`, each of which runs in its own process and prints a line per case."""
