# SPDX-License-Identifier: GPL-3.0-or-later
"""Tests of the Snakemake workflow: real verbs, on this machine and on a stand-in for a cluster."""
