# SPDX-License-Identifier: GPL-3.0-or-later
"""Records a rig: plans poses, detects influences, evaluates the poses, and adds poses where a model is worst."""
