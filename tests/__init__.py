# SPDX-License-Identifier: GPL-3.0-or-later
"""The tests of FDDA, a folder for each tier. They import each other relatively."""
