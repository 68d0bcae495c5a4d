# SPDX-License-Identifier: MIT
"""Reader of Mitsuba scene files, for importers and captures."""
