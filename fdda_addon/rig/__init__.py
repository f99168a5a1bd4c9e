# SPDX-License-Identifier: GPL-3.0-or-later
"""What of a scene is the rig: its joints, skin and controls, the modifiers it replaces, and what is refused."""
