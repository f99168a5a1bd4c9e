# SPDX-License-Identifier: GPL-3.0-or-later
"""Recording and training of many characters on many machines, as a graph of tasks that run verbs.

Several engines can run the graph: Dask, OpenJD and Flamenco. The farm imports no Blender, because each verb runs in its
own process.
"""
