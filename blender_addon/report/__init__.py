# SPDX-License-Identifier: GPL-3.0-or-later
"""The fidelity report: differences between the export and Cycles, with pictures."""
