# SPDX-License-Identifier: GPL-3.0-or-later
"""Files that pass between programs: models, reports, messages and caches."""
