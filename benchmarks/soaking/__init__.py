# SPDX-License-Identifier: GPL-3.0-or-later
"""The parts of `benchmarks/soak.py`, each a process that says a line for every case."""
