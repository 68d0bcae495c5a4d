# SPDX-License-Identifier: MIT
"""Studies that were made once, for a decision or a table of the docs; each module is a command."""
