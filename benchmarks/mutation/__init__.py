# SPDX-License-Identifier: MIT
"""Mutation testing: changes of modules, and the tests that cover the changed lines."""
