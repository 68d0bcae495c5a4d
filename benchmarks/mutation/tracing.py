# SPDX-License-Identifier: MIT
"""Pytest plugin that records the lines of given files that each test executes, and the test's seconds.

``MUTATION_FILES`` names the files (separated by ``:``), ``MUTATION_TRACE`` the JSON file that is written:
``{test: {"seconds": s, "lines": {file: [line, ...]}}}``. Lines run by a fixture count for every test that
uses it. Child processes of a test write their lines into ``MUTATION_CHILDREN``, a folder.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest

from benchmarks.mutation.lines import Lines, Tracer


class Recorder:
    """Pytest hooks that record lines and seconds by test."""

    def __init__(self, tracer: Tracer, children: Path):
        self.tracer, self.children = tracer, children
        self.of_test: dict[str, Lines] = defaultdict(set)
        self.of_fixture: dict[str, Lines] = defaultdict(set)
        self.fixtures: dict[str, set[str]] = {}
        self.seconds: dict[str, float] = defaultdict(float)

    def _taken(self) -> Lines:
        lines, self.tracer.lines = self.tracer.lines, set()
        for path in self.children.iterdir():
            for text in path.read_text().splitlines():
                line, _, file = text.partition(":")
                lines.add((file, int(line)))
            path.write_text("")
        return lines

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Any:
        before = self._taken()
        try:
            return (yield)
        finally:
            name = f"{fixturedef.baseid}:{fixturedef.argname}"
            if fixturedef.scope != "function":
                self.of_fixture[name] |= self._taken()
            self.tracer.lines |= before

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: Any, nextitem: Any) -> Any:
        self._taken()
        start = time.perf_counter()
        try:
            return (yield)
        finally:
            self.seconds[item.nodeid] = time.perf_counter() - start
            self.of_test[item.nodeid] |= self._taken()
            info = item._fixtureinfo.name2fixturedefs
            self.fixtures[item.nodeid] = {f"{d.baseid}:{d.argname}" for defs in info.values() for d in defs}

    def pytest_sessionfinish(self) -> None:
        sys.settrace(None)
        found = {}
        for test, lines in self.of_test.items():
            all_lines = lines.union(*(self.of_fixture.get(name, set()) for name in self.fixtures[test]))
            by_file: dict[str, list[int]] = defaultdict(list)
            for file, line in sorted(all_lines):
                by_file[file].append(line)
            found[test] = {"seconds": round(self.seconds[test], 3), "lines": by_file}
        Path(os.environ["MUTATION_TRACE"]).write_text(json.dumps(found))


def pytest_configure(config: Any) -> None:
    if "MUTATION_TRACE" in os.environ:
        tracer = Tracer(os.environ["MUTATION_FILES"].split(":"))
        config.pluginmanager.register(Recorder(tracer, Path(os.environ["MUTATION_CHILDREN"])))
        tracer.start()
