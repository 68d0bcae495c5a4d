# SPDX-License-Identifier: GPL-3.0-or-later
"""Sources of materials: functions that build node graphs, and the catalogue of their arguments."""
