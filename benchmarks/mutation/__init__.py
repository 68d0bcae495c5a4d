# SPDX-License-Identifier: MIT
"""Mutation testing: changes modules, and runs the tests that cover the changed lines."""
