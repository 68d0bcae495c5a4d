# SPDX-License-Identifier: GPL-3.0-or-later
"""The fidelity report: how the export differs from what Cycles shows, with pictures."""
