# SPDX-License-Identifier: GPL-3.0-or-later
"""What can be wrong with a recording, found before it is trained on: a module for each kind of check."""
