# SPDX-License-Identifier: MIT
"""Attacks readers with damaged and malicious files, which must yield a valid object or a clear error.

A case writes one input into a folder and reads it. :func:`attack` runs a case many times in a child process,
so that crashes of native libraries and endless loops do not end the tests. In the child, an audit hook lets a
reader open, list, make and remove files only in the case's folder, and forbids it to unpickle objects, start
processes and open connections.

``HOSTILE_EXAMPLES=20000`` sets the number of inputs per case. To repeat one input in the same process:

    python -m tests.hostile tests.datagen.hostile_cases shard 1234
"""

from __future__ import annotations

import contextlib
import copy
import faulthandler
import importlib
import json
import multiprocessing
import os
import random
import resource
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from multiprocessing.sharedctypes import RawArray
from pathlib import Path
from typing import Any
from unittest import mock

import psutil
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as starting_at
from hypothesis import strategies as st

from datagen.foundation.errors import InputError
from tests.conftest import REPOSITORY

EXAMPLES = int(os.environ.get("HOSTILE_EXAMPLES", "60"))
SEED = int(os.environ.get("HOSTILE_SEED", "0"))
MAX_SECONDS = 10.0
MAX_BYTES = 2 << 30
PRISTINE = 0.05
"""Share of undamaged inputs, which show that the reader accepts valid ones."""
MAX_MESSAGE = 200_000
"""Greatest length of an error in characters: a small file must not fill a log."""

HOSTILE_VALUES: list[Any] = [
    None, True, -1, 0, 1e308, -1e308, 2**70, "", "..", "../../etc/passwd", "/etc/passwd", "a\x00b", "é" * 300,
    [], {}, [[]], {"": {}}, "NaN", [1] * 1000, {"texture": "x.png", "encoding": "linear"}, "​", "C:\\x",
    "a\x00b.png", "a\x00b.ply",
    "/dev/zero", "/dev/stdin", "../outside/secret.png", "../outside/secret.ply", "../outside/secret.json",
    "link.png", "link.ply", "link", "fifo", "fifo.png", "fifo.ply", "file:///etc/passwd", "~/x.png", 1e-320,
    float("inf"), float("nan"), "1e999", "9" * 5000, 10**400,
]  # fmt: skip


@dataclass(frozen=True)
class Case:
    """``write`` writes one input into the case's folder and returns its path; ``read`` reads it."""

    write: Callable[[random.Random], Path]
    read: Callable[[Path], object]


CaseMaker = Callable[[Path], Case]
PRELOADED = ("tests.datagen.hostile_cases", "tests.model.hostile_cases")
"""Modules that the fork server imports once; those that cannot be imported are ignored."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of an attack: numbers of accepted and refused inputs, the child's peak memory and CPU time."""

    name: str
    accepted: int
    refused: int
    peak_mb: float
    cpu_s: float


# ---------------------------------------------------------------------- inputs


def mutate(document: Any, rng: random.Random) -> Any:
    """Return a JSON document with up to four values replaced, removed, added or repeated."""
    document = copy.deepcopy(document)
    if rng.random() < PRISTINE:
        return document
    for _ in range(rng.randint(1, 4)):
        places: list[tuple[Any, Any]] = []
        _collect(document, places)
        if not places:
            return hostile_value(rng)
        container, key = rng.choice(places)
        action = rng.random()
        if action < 0.6:
            container[key] = hostile_value(rng)
        elif action < 0.75:
            del container[key]
        elif action < 0.9 and isinstance(container, dict):
            container[str(hostile_value(rng))[:40]] = hostile_value(rng)
        elif isinstance(container, list):
            container.extend(container[:50])
    return document


def hostile_value(rng: random.Random) -> Any:
    """Return a value that readers often mishandle."""
    return copy.deepcopy(rng.choice(HOSTILE_VALUES))


def _collect(value: Any, places: list[tuple[Any, Any]]) -> None:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in items:
        places.append((value, key))
        _collect(child, places)


def damage(data: bytes, rng: random.Random) -> bytes:
    """Return the bytes with flipped, truncated, repeated or overwritten parts, or rarely unchanged."""
    content = bytearray(data)
    if rng.random() < PRISTINE:
        return data
    for _ in range(rng.randint(1, 5)):
        if not content:
            return b""
        # A share of the damage is confined to the header, where it has more effect than in pixels.
        end = len(content) if rng.random() < 0.6 else min(len(content), 256)
        position = rng.randrange(end)
        action = rng.random()
        if action < 0.45:
            content[position] ^= rng.randint(1, 255)
        elif action < 0.6:
            del content[position:]
        elif action < 0.75:
            content[position:position] = content[max(0, position - 64) : position]
        elif action < 0.9:
            width = rng.choice((2, 4, 8))
            value = rng.choice((0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1, 10**9))
            content[position : position + width] = (value % 256**width).to_bytes(width, "little")
        else:
            content[position : position + 8] = b"\xff" * 8
    return bytes(content)


def write_fresh(path: Path, data: bytes) -> Path:
    """Write a file after removing an existing one, because overwriting is slow on some disks."""
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    else:
        path.unlink(missing_ok=True)
    path.write_bytes(data)
    return path


def write_document(path: Path, document: Any, rng: random.Random) -> Path:
    """Write a JSON document, mutated as a tree or damaged as bytes."""
    if rng.random() < 0.75:
        return write_fresh(path, json.dumps(mutate(document, rng)).encode("utf-8", "surrogatepass"))
    return write_fresh(path, damage(json.dumps(document).encode(), rng))


def set_traps(folder: Path) -> None:
    """Create links that lead out of the folder and pipes without a writer, as targets of hostile names."""
    outside = folder.parent / "outside"
    outside.mkdir(exist_ok=True)
    for suffix in ("png", "ply", "json"):
        (outside / f"secret.{suffix}").write_bytes(b"secret")
        (folder / f"link.{suffix}").symlink_to(outside / f"secret.{suffix}")
        os.mkfifo(folder / f"fifo.{suffix}")
    (folder / "link").symlink_to(outside)
    os.mkfifo(folder / "fifo")


# ---------------------------------------------------------------------- the child


@dataclass
class _Guard:
    """Audit hook that records forbidden actions while ``is_active``."""

    folder: Path
    is_active: bool = False
    violations: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.inside = os.path.realpath(self.folder) + os.sep
        code = {sys.prefix, sys.base_prefix, str(REPOSITORY), *filter(os.path.isdir, sys.path)}
        self.code = tuple(os.path.realpath(path) + os.sep for path in code)

    def hook(self, event: str, arguments: tuple) -> None:
        if not self.is_active or event not in _WATCHED:
            return
        if event in _PATH_EVENTS:
            num_paths, first_descriptor = _PATH_EVENTS[event]
            for index, path in enumerate(arguments[:num_paths]):
                if not isinstance(path, str | bytes):
                    continue  # a descriptor; its opening has been audited
                name = os.fsdecode(path)
                if first_descriptor and arguments[first_descriptor + index] not in (-1, None):
                    name = f"/proc/self/fd/{arguments[first_descriptor + index]}/{name}"
                is_followed = event in _READ_EVENTS and not (event == "open" and _is_nofollow(arguments))
                if not self.is_admitted(name, event, is_followed):
                    self.report(f"{event} {name!r}")
        else:
            self.report(f"{event} {str(arguments)[:200]}")

    def is_admitted(self, path: str, event: str, is_followed: bool) -> bool:
        real = os.path.realpath(path)
        if not is_followed:  # the event concerns the link, not its target
            real = str(Path(os.path.realpath(Path(path).parent)) / Path(path).name)
        if (real + os.sep).startswith(self.inside):
            return True
        return event in _READ_EVENTS and (real + os.sep).startswith(self.code)

    def report(self, what: str) -> None:
        self.violations.append(what)
        raise PermissionError(f"a reader may not: {what}")

    @contextlib.contextmanager
    def active(self) -> Iterator[None]:
        self.is_active = True
        try:
            yield
        finally:
            self.is_active = False


def _is_nofollow(arguments: tuple) -> bool:
    return isinstance(arguments[2], int) and bool(arguments[2] & os.O_NOFOLLOW)


_READ_EVENTS = ("open", "os.listdir", "os.scandir")
_PATH_EVENTS = {
    "open": (1, 0), "os.listdir": (1, 0), "os.scandir": (1, 0), "os.mkdir": (1, 2), "os.rename": (2, 2),
    "os.remove": (1, 1), "os.rmdir": (1, 1), "os.link": (2, 2), "os.symlink": (2, 0), "os.truncate": (1, 0),
    "os.chmod": (1, 2), "os.chown": (1, 3), "os.utime": (1, 3),
}  # fmt: skip
"""Audit events of files: number of leading path arguments; index of the first folder descriptor, or 0."""
_WATCHED = {
    *_PATH_EVENTS, "pickle.find_class", "subprocess.Popen", "os.system", "os.exec", "os.posix_spawn",
    "os.fork", "socket.connect", "socket.bind",
}  # fmt: skip


def run_one(case: Case, guard: _Guard, number: int) -> bool:
    """Write and read one input; return True if it is accepted, False if it is refused with a clear error."""
    path = case.write(random.Random(number))
    try:
        with guard.active():
            case.read(path)
        is_accepted = True
    except InputError as error:
        is_accepted = False
        message = str(error)
        assert len(message) < MAX_MESSAGE, f"an error of {len(message)} characters"
        assert all(str(problem.where) and problem.expected for problem in error.problems), message
    assert not guard.violations, guard.violations
    return is_accepted


def _make(module: str, name: str, folder: Path) -> tuple[Case, _Guard]:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "tmp").mkdir(exist_ok=True)
    tempfile.tempdir = str(folder / "tmp")  # unpacked members are then inside the folder
    case = importlib.import_module(module).CASES[name](folder)
    guard = _Guard(folder)
    sys.addaudithook(guard.hook)
    return case, guard


def _child(module: str, name: str, folder: Path, examples: int, progress: Any, connection: Any) -> None:
    counts = {True: 0, False: 0}
    folder.mkdir(parents=True, exist_ok=True)
    log = os.open(_log(folder), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):  # native libraries print messages for every input
        os.dup2(log, stream)
    faulthandler.enable(log)
    try:
        case, guard = _make(module, name, folder)

        @starting_at(SEED)
        @settings(
            max_examples=examples,
            deadline=None,  # the parent limits the time, including that of native code
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(number=st.integers(0, 2**64 - 1))
        def one(number: int) -> None:
            progress[0], progress[1] = progress[0] + 1, number
            counts[run_one(case, guard, number)] += 1

        one()
        usage = resource.getrusage(resource.RUSAGE_SELF)
        peak = usage.ru_maxrss / 1024
        connection.send(Outcome(name, counts[True], counts[False], peak, usage.ru_utime + usage.ru_stime))
    except BaseException:
        connection.send(traceback.format_exc())


def _log(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.log")


# ---------------------------------------------------------------------- the parent


def attack(
    module: str, name: str, folder: Path, examples: int = EXAMPLES, max_bytes: int = MAX_BYTES
) -> Outcome:
    """Run a case ``examples`` times; fail the test on a crash, a hang, excessive memory or another fault."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(PRELOADED))
    progress = RawArray("Q", 2)
    ours, theirs = context.Pipe(duplex=False)
    arguments = (module, name, folder, examples, progress, theirs)
    process = context.Process(target=_child, args=arguments, daemon=True)
    with mock.patch.dict(os.environ, OPENBLAS_NUM_THREADS="1"):  # threads only slow down 4 x 4 matrices
        process.start()  # the first child starts the fork server, whose environment all children inherit
    theirs.close()
    again = f"again: python -m tests.hostile {module} {name}"
    count, watch = 0, _Watch(process.pid)

    def crashed() -> None:
        process.join()
        last = _log(folder).read_text(errors="replace")[-3000:]
        pytest.fail(f"{last}\n{name}: the reader crashed with {process.exitcode}; {again} {progress[1]}")

    try:
        while not ours.poll(0.1):
            if not process.is_alive() and not ours.poll():
                crashed()
            if progress[0] != count:
                count = progress[0]
                watch.start()
            # start-up with imports may take longer than an input
            if watch.seconds() > (MAX_SECONDS if count else 120.0):
                pytest.fail(f"{name}: over {MAX_SECONDS} s for one input; {again} {progress[1]}")
            if watch.memory() > max_bytes:
                pytest.fail(f"{name}: over {max_bytes >> 20} MB of memory; {again} {progress[1]}")
        try:
            outcome = ours.recv()
        except EOFError:
            crashed()
    finally:
        process.kill()
        process.join()
        ours.close()
    if isinstance(outcome, str):
        pytest.fail(f"{outcome}\n{name}: {again} {progress[1]}")
    assert outcome.accepted + outcome.refused >= examples, outcome
    assert examples < 60 or min(outcome.accepted, outcome.refused) > 0, f"{outcome}: one-sided"
    assert outcome.peak_mb * 2**20 < max_bytes, outcome
    print(
        f"{name}: {outcome.accepted + outcome.refused} inputs, {outcome.accepted} read, {outcome.refused} "
        f"refused, peak {outcome.peak_mb:.0f} MB, {outcome.cpu_s:.0f} s"
    )
    return outcome


class _Watch:
    """Measures the memory of a child and the time of one input: processor time, which other load does not
    affect, or wall time while the child sleeps."""

    def __init__(self, pid: int | None):
        self.process = psutil.Process(pid)
        self.start()

    def start(self) -> None:
        """Begin a new input."""
        self.begun, self.asleep_since = self._cpu(), time.monotonic()

    def seconds(self) -> float:
        """The larger of processor time and time asleep since the start, in seconds."""
        with contextlib.suppress(psutil.Error):  # the process has ended
            if self.process.status() not in (psutil.STATUS_SLEEPING, psutil.STATUS_DISK_SLEEP):
                self.asleep_since = time.monotonic()
        return max(self._cpu() - self.begun, time.monotonic() - self.asleep_since)

    def memory(self) -> int:
        """Resident memory in bytes."""
        try:
            return self.process.memory_info().rss
        except psutil.Error:
            return 0  # the process has ended

    def _cpu(self) -> float:
        try:
            return sum(self.process.cpu_times()[:2])
        except psutil.Error:
            return 0.0


def main() -> None:
    """Read one input again, in this process, and print the outcome."""
    module, name, number = sys.argv[1:]
    folder = Path(tempfile.mkdtemp(prefix="hostile-")) / "case"
    case, guard = _make(module, name, folder)
    print(f"input in {folder}")
    print("read" if run_one(case, guard, int(number)) else "refused")


if __name__ == "__main__":
    main()
