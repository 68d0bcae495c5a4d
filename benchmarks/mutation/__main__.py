# SPDX-License-Identifier: MIT
"""Mutates modules, one change at a time, and measures the share of changes that their tests detect.

    python -m benchmarks.mutation [TARGET ...] [--number N] [--seed S] [--again] [--work DIR] [--out FILE]

For each target (targets.yaml) the tests run once with line tracing; then a seeded sample of the mutants on
those lines is tried, each with the tests that run its line, fastest first, until one fails. Everything
happens in a copy of the project below ``--work``. Results are written after each mutant to ``--out``; the
same command resumes after them, and ``--again`` repeats the survivors. A mutant is identified by its
statement and its function, so results remain valid when other code changes.

``--list`` only prints the survivors, ``--table`` only the counts in Markdown.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from benchmarks.mutation.mutants import Mutant, find_mutants
from benchmarks.mutation.targets import TARGETS, Target
from datagen.formats.base import write_bytes_atomically

PROJECT = Path(__file__).resolve().parents[2]
EQUIVALENT = Path(__file__).with_name("equivalent.yaml")
# time limit of a mutant's tests: minimum in seconds, and multiple of their time without a mutation
MIN_TIMEOUT_S, PATIENCE = 60.0, 6.0
SURVIVED = 0  # exit code of pytest if all tests pass


class Copy:
    """A copy of the project in which mutants are tried, with its own caches."""

    def __init__(self, work: Path):
        self.root, self.work = work / "project", work
        self._warm: subprocess.Popen[str] | None = None
        start = self.root / "sitecustomize.py"
        if self.root.exists():
            if not start.is_file():
                sys.exit(f"--work: {self.root} is not a copy of an earlier run: choose another folder")
            shutil.rmtree(self.root)
        self.root.mkdir()
        start.write_text("from benchmarks.mutation.lines import trace_child\n\ntrace_child()\n")
        command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        names = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, check=True).stdout
        for name in names.split("\0"):
            if name and (PROJECT / name).is_file():
                (self.root / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(PROJECT / name, self.root / name)
        for name in ("home", "numba", "children"):
            (work / name).mkdir(exist_ok=True)

    def environment(self, **more: str) -> dict[str, str]:
        """Environment variables of processes in the copy, including ``more``."""
        own = {
            "PYTHONPATH": str(self.root),
            "HOME": str(self.work / "home"),
            "NUMBA_CACHE_DIR": str(self.work / "numba"),
            "PYTHONPYCACHEPREFIX": str(self.work / "bytecode"),
        }
        return {**os.environ, **own, **more}

    def run_once(self, tests: tuple[str, ...], **more: str) -> None:
        """Run test files in a process with environment variables ``more``; exit if a test fails."""
        command = [sys.executable, "-m", "pytest", *self._arguments(tests)]
        if more:
            command += ["-p", "benchmarks.mutation.tracing"]
        done = subprocess.run(
            command, cwd=self.root, env=self.environment(**more), capture_output=True, text=True
        )
        if done.returncode != 0:
            sys.exit(f"the tests fail without any mutant:\n{done.stdout[-3000:]}{done.stderr[-1000:]}")

    def run(self, tests: list[str], timeout_s: float) -> tuple[int, str]:
        """Run tests in warm.py; returns pytest's exit code (negative: crash or timeout) and its output."""
        if self._warm is None:
            command = [sys.executable, "-m", "benchmarks.mutation.warm"]
            self._warm = subprocess.Popen(
                command, cwd=self.root, env=self.environment(PYTHONDONTWRITEBYTECODE="1"), text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            )  # fmt: skip
        assert self._warm.stdin is not None and self._warm.stdout is not None
        output = self.work / "output.txt"
        request = {"arguments": self._arguments(tests), "timeout_s": timeout_s, "output": str(output)}
        print(json.dumps(request), file=self._warm.stdin, flush=True)
        return int(self._warm.stdout.readline()), output.read_text(errors="replace")

    def _arguments(self, tests: Sequence[str]) -> list[str]:
        quiet = ["-q", "-x", "--no-header", "-p", "no:cacheprovider"]
        return [*quiet, f"--basetemp={self.work / 'tests'}", *tests]


def trace(copy: Copy, target: Target) -> dict[str, Any]:
    """Run a target's tests; returns for each test its seconds and the executed lines, as sets by module."""
    for path in (copy.work / "children").iterdir():
        path.unlink()
    found = copy.work / "trace.json"
    files = ":".join(str(copy.root / module) for module in target.modules)
    more = {"MUTATION_FILES": files, "MUTATION_TRACE": str(found)}
    copy.run_once(target.tests, **more, MUTATION_CHILDREN=str(copy.work / "children"))
    tests: dict[str, Any] = json.loads(found.read_text())
    for test in tests.values():
        test["lines"] = {
            str(Path(file).relative_to(copy.root)): set(lines) for file, lines in test["lines"].items()
        }
    return tests


def covering(mutant: Mutant, module: str, tests: dict[str, Any]) -> list[str]:
    """Names of the ``tests`` that run a mutant's lines in ``module``, fastest first."""
    lines = set(range(mutant.first_line, mutant.last_line + 1))
    chosen = [name for name, test in tests.items() if lines & test["lines"].get(module, set())]
    return sorted(chosen, key=lambda name: tests[name]["seconds"])


def draw(
    root: Path, target: Target, tests: dict[str, Any], number: int, seed: int
) -> list[tuple[str, Mutant, list[str]]]:
    """Draw ``number`` of a target's mutants on tested lines, at most one per statement, alternating between
    kinds; returns module, mutant and the tests that run it.
    """
    by_kind: dict[str, list[tuple[str, str, Mutant, list[str]]]] = defaultdict(list)
    for module in target.modules:
        source = (root / module).read_text()
        compiled = _untraced_lines(source)
        for mutant in find_mutants(module, source):
            # compiled code, and code that runs on import (default values), is not traced: run all tests
            is_signature = mutant.statement.startswith(("def ", "async def "))
            if not mutant.function or mutant.first_line in compiled or is_signature:
                names = sorted(tests, key=lambda name: tests[name]["seconds"])
            else:
                names = covering(mutant, module, tests)
            if names:
                order = hashlib.sha256(f"{seed} {mutant.key}".encode()).hexdigest()
                by_kind[mutant.kind].append((order, module, mutant, names))
    queues = [sorted(found, key=lambda row: row[0]) for _, found in sorted(by_kind.items())]
    taken: set[tuple[str, int]] = set()
    drawn: list[tuple[str, Mutant, list[str]]] = []
    while len(drawn) < number and any(queues):
        for queue in queues:
            while queue:
                _, module, mutant, names = queue.pop(0)
                if (module, mutant.first_line) not in taken:
                    taken.add((module, mutant.first_line))
                    drawn.append((module, mutant, names))
                    break
    return drawn[:number]


def _untraced_lines(source: str) -> set[int]:
    """Numbers of the lines of compiled functions, which cannot be traced."""
    lines: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            names = {ast.unparse(decorator) for decorator in node.decorator_list}
            if names & {"compiled", "dr.syntax"}:
                lines.update(range(node.lineno, (node.end_lineno or 0) + 1))
    return lines


def attempt(
    copy: Copy, module: str, mutant: Mutant, names: list[str], tests: dict[str, Any]
) -> dict[str, Any]:
    """Run tests ``names`` on one mutant; returns the verdict, the seconds and the test that detected it."""
    path = copy.root / module
    source, times = path.read_text(), path.stat()
    usual = sum(tests[name]["seconds"] for name in names)
    if "@compiled" in source:  # callers that inline a changed function must be recompiled
        shutil.rmtree(copy.work / "numba", ignore_errors=True)
        usual += 30.0
    start = time.perf_counter()
    try:
        path.write_text(mutant.apply(source))
        code, output = copy.run(names, max(MIN_TIMEOUT_S, PATIENCE * usual))
    finally:
        path.write_text(source)
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    failed = [line for line in output.splitlines() if line.startswith(("FAILED", "ERROR"))]
    if code > SURVIVED and not failed:  # pytest failed without a failing test: the run itself is broken
        sys.exit(f"pytest ended with {code}:\n{output[-2000:]}")
    return {
        "verdict": "survived" if code == SURVIVED else "killed",
        "by": "" if code == SURVIVED else (failed[-1][:160] if failed else f"exit code {code}"),
        "seconds": round(time.perf_counter() - start, 1),
        "tests": len(names),
    }


def equivalents() -> dict[str, str]:
    """Reasons why mutants behave like the original code, by the mutant's key, from equivalent.yaml."""
    return {row["key"]: row["why"] for row in yaml.safe_load(EQUIVALENT.read_text())}


def table(results: dict[str, dict[str, Any]]) -> str:
    """Markdown table of the number of mutants by target and verdict."""
    known = equivalents()
    rows = ["| part | mutants | killed | equivalent | survived | killed of those that matter |",
            "|---|---|---|---|---|---|"]  # fmt: skip
    sums = [0, 0, 0]
    for name in [*TARGETS, "all"]:
        own = [key for key, row in results.items() if row["target"] == name]
        killed = sum(results[key]["verdict"] == "killed" for key in own)
        same = sum(results[key]["verdict"] != "killed" and key in known for key in own)
        counts = [len(own), killed, same] if name != "all" else sums
        if name != "all":
            sums = [total + count for total, count in zip(sums, counts, strict=True)]
        left = counts[0] - counts[1] - counts[2]
        share = counts[1] / max(counts[0] - counts[2], 1)
        rows.append(f"| {name} | {counts[0]} | {counts[1]} | {counts[2]} | {left} | {share:.0%} |")
    return "\n".join(rows)


def survivors(results: dict[str, dict[str, Any]]) -> str:
    """Text that lists the mutants that no test detected, with the reason if known."""
    known, lines = equivalents(), []
    for key, row in results.items():
        if row["verdict"] == "survived":
            lines.append(f"{key} {row['module']}:{row['line']} {row['function']} [{row['kind']}] "
                         f"{row['text']!r} -> {row['new']!r}\n    {row['statement']}")  # fmt: skip
            if key in known:
                lines.append(f"    equivalent: {known[key]}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("targets", nargs="*", help=f"some of {', '.join(TARGETS)}; default: all")
    parser.add_argument("--number", type=int, help="number of mutants per target; default: the target's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--again", action="store_true", help="try surviving mutants again, unless equivalent")
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "mutation")
    parser.add_argument("--out", type=Path, default=Path("mutation.json"))
    parser.add_argument("--list", action="store_true", help="print the survivors")
    parser.add_argument("--table", action="store_true", help="print the counts")
    options = parser.parse_args()
    unknown = set(options.targets) - set(TARGETS)
    if unknown:
        parser.error(f"no target {', '.join(sorted(unknown))}: expected some of {', '.join(TARGETS)}")
    results: dict[str, dict[str, Any]] = json.loads(options.out.read_text()) if options.out.exists() else {}
    if options.list or options.table:
        print(survivors(results) if options.list else table(results))
        return
    options.work.mkdir(parents=True, exist_ok=True)
    copy, known = Copy(options.work.resolve()), equivalents()
    for name in options.targets or TARGETS:
        target = TARGETS[name]
        tests = trace(copy, target)
        drawn = draw(copy.root, target, tests, options.number or target.number, options.seed)
        for module, mutant, names in drawn:
            before = results.get(mutant.key)
            is_again = options.again and mutant.key not in known
            if before and not (is_again and before["verdict"] == "survived"):
                continue
            found = attempt(copy, module, mutant, names, tests)
            results[mutant.key] = {
                "target": name,
                "module": module,
                "line": mutant.first_line,
                "function": mutant.function,
                "kind": mutant.kind,
                "text": mutant.text,
                "new": mutant.new,
                "statement": mutant.statement,
                **found,
            }
            write_bytes_atomically(options.out, json.dumps(results, indent=1).encode())
            print(f"{found['verdict']:8} {found['seconds']:6.1f} s  {module}:{mutant.first_line}  "
                  f"{mutant.text!r} -> {mutant.new!r}", flush=True)  # fmt: skip
    print(table(results))


if __name__ == "__main__":
    main()
