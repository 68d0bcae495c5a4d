# SPDX-License-Identifier: GPL-3.0-or-later
"""Material sources: few families of node graphs with parameters, many materials."""
