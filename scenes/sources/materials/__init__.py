# SPDX-License-Identifier: GPL-3.0-or-later
"""Material sources: a few parametric families of node graphs give many materials."""
