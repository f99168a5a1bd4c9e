# SPDX-License-Identifier: GPL-3.0-or-later
"""The Python that trains.

`choice` selects it and `check` checks it, with a `CheckResult`. `folder` is the folder of the add-on's environment,
which `creation` installs. `session` caches results for panels.
"""
