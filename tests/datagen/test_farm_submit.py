# SPDX-License-Identifier: MIT
"""`farm submit` with hostile names and options: its scripts run under bash with substitute commands.

These record their arguments; `sbatch` also runs the script as Slurm would, one task after another.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import stat
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from datagen.farm.folder import DatasetFolder
from datagen.farm.job_options import SlurmOptions
from datagen.farm.submission import submit
from datagen.foundation.errors import InputError
from tests.datagen.small_plan import plan_small

_PAYLOADS = ("touch pwned", "pwned", "/usr/bin/touch pwned")
_WRAPPINGS = (
    "{}", "; {}", "& {} &", "| {}", "&& {} #", "|| {}", "$({})", "`{}`", "\n{}\n", "\r\n{}\n", "{{{},}}",
    "\n#SBATCH --wrap={}\n", "'; {} #", '"; {} #', "\\\"; {} #", "\\'; {} \\", "${{x:-$({})}}", "<({})",
    "*{}*", ">pwned {}", "$(({}))", "\x01{}", "\x1b]0;{}\x07", "'$({})'", "\"$({})\"", "'\"'\"'$({})",
    "\u2028{}", "\udc80{}", "# {}", "!{}", "~{}", "%a %% %j {}", "--wrap={}", "-x {}", "=(){{ {}; }}",
    " {} ", "\t{}", "ä{}ö", "[{}]", "\n\n#!/bin/bash\n{}\nexit 0\n", "EOF\n{}\nEOF", "\\\n{}", "{}\\",
    "$'\\n{}'", "$IFS{}",
    ";{};#", "\v{}", "\x7f{}", "\x85{}", "\n--array=0-9\n{}",
)  # fmt: skip
assert len(_WRAPPINGS) == 50
HOSTILE = [wrapping.format(_PAYLOADS[i % 3]) for i, wrapping in enumerate(_WRAPPINGS)]

_NOTE_TAKER = r"""#!/bin/sh
printf '%s\0' "$#" "${0##*/}" "$@" >> "$NOTES"
[ "${0##*/}" = sbatch ] || exit 0
for script; do :; done
case "${script##*/}" in units*) tasks="0 1" ;; *) tasks=- ;; esac
for task in $tasks; do
    SLURM_ARRAY_JOB_ID=7 SLURM_ARRAY_TASK_ID=$task SLURM_JOB_ID=9 /bin/bash -x "$script" >> "$TRACE" 2>&1
done
echo "7;cluster"
"""
_WORDS = {
    "set", "folder", "unit", "task", "code", "worker", "datagen", "trap", "wait", "kill", "exit", "[",
    "source_me",
}  # fmt: skip
"""Commands that the scripts may execute and variables that they may assign."""


@dataclass
class Desk:
    """A planned folder, and the records of the substitute commands, which alone are on PATH."""

    folder: DatasetFolder
    notes: Path
    trace: Path
    here: Path

    def commands(self) -> list[list[str]]:
        """Return the recorded commands with their arguments, in order, and clear the record."""
        words = self.notes.read_text().split("\0")[:-1] if self.notes.exists() else []
        self.notes.write_text("")
        found = []
        while words:
            end = int(words[0]) + 2
            found.append(words[1:end])
            words = words[end:]
        return found

    def executed(self) -> set[str]:
        """Return the commands that bash executed and the variables that it assigned, and clear the trace."""
        text = self.trace.read_text() if self.trace.exists() else ""
        self.trace.write_text("")
        # `bash -x` prefixes commands with one plus sign, and those in substitutions with more
        commands = re.findall(r"^(\++) (?:'?)([^\s=']*)", text, re.M)
        return {word if len(depth) == 1 else f"nested {word}" for depth, word in commands}


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> DatasetFolder:
    return plan_small(tmp_path_factory.mktemp("plan") / "set", tmp_path_factory.mktemp("l") / "library", 2)


@pytest.fixture
def desk(planned: DatasetFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Desk:
    programs, here = tmp_path / "programs", tmp_path / "here"
    programs.mkdir()
    here.mkdir()
    for name in ("sbatch", "squeue", "scontrol", "datagen", "touch", "pwned", "source_me"):
        path = programs / name
        path.write_text(_NOTE_TAKER)
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
    notes, trace = tmp_path / "notes", tmp_path / "trace"
    monkeypatch.setenv("PATH", f"{programs}:/bin")
    monkeypatch.setenv("NOTES", str(notes))
    monkeypatch.setenv("TRACE", str(trace))
    monkeypatch.chdir(here)
    shutil.rmtree(planned.root / "jobs", ignore_errors=True)
    return Desk(planned, notes, trace, here)


def _expected(root: str) -> list[list[str]]:
    """Return the commands expected of the jobs for two units and of the collecting job."""
    units = [["datagen", "run", root, "--unit", str(index), "--attempts", "3"] for index in (0, 1)]
    workers = ["--workers", "1"]
    return [
        *units,
        ["datagen", "farm", "status", root],
        ["datagen", "run", root, "--only", "index", "--deep"],
        ["datagen", "verify", root, *workers],
        ["datagen", "report", root, *workers],
    ]


def _check_nothing_else_ran(desk: Desk, root: str) -> None:
    called = desk.commands()
    jobs = [command for command in called if command[0] == "sbatch"]
    assert [job[-1] for job in jobs] == [f"{root}/jobs/{n}.sbatch" for n in ("units-0", "collect")]
    assert [command for command in called if command[0] not in ("sbatch", "squeue")] == _expected(root)
    assert desk.executed() <= _WORDS
    assert list(desk.here.iterdir()) == []


@pytest.mark.parametrize("name", HOSTILE, ids=[ascii(name) for name in HOSTILE])
def test_a_hostile_folder_name_executes_nothing(name: str, desk: Desk, tmp_path: Path) -> None:
    """Submission works or is refused; the shell never interprets the name."""
    root = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + os.fsencode(name)))
    root.parent.mkdir(parents=True, exist_ok=True)
    desk.folder.root.rename(root)
    try:
        try:
            submit(root, SlurmOptions())
        except InputError as error:
            assert re.search(r"[\\\"\x00-\x1f\x7f-\x9f\u2028\udc80]", name), f"{name!r} needs no refusal"
            assert error.problems[0].field == "folder" and str(error).isprintable()
            assert desk.commands() == [] and not list(root.glob("jobs/*.sbatch"))
        else:
            _check_nothing_else_ran(desk, str(root))
        (root / "jobs").mkdir(exist_ok=True)
        try:
            submission = submit(root, SlurmOptions(), engine="shell")
        except InputError as error:
            assert str(error).isprintable()
            return
        lines = submission.scripts[0].read_text().splitlines()
        assert len(lines) == 2
        subprocess.run(["/bin/bash", "-x", str(submission.scripts[0])], check=True, capture_output=True)
        assert desk.commands() == _expected(str(root))[:2]
    finally:
        root.rename(desk.folder.root)


_FREE_TEXTS = ("partition", "account", "qos", "constraint", "exclude", "mail_user", "mail_type",
               "collect_partition", "time_limit", "memory", "collect_time", "collect_memory")  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE, ids=[ascii(name) for name in HOSTILE])
def test_hostile_options_execute_nothing(name: str, desk: Desk) -> None:
    root = str(desk.folder.root)
    for field in _FREE_TEXTS:
        try:
            options = SlurmOptions(**{field: name})  # type: ignore[arg-type]
        except InputError as error:
            assert len(error.problems) == 1 and str(error).isprintable()
        else:
            assert re.fullmatch(r"[\w.&|*()\[\],:! -]+", name), f"{field} took {name!r}"
            submit(desk.folder.root, options)
            _check_nothing_else_ran(desk, root)
    for field in ("sbatch_options", "collect_options"):
        for text in (name, f"comment={name}", f"--comment={name}"):
            try:
                options = SlurmOptions(**{field: (text,)})  # type: ignore[arg-type]
            except InputError as error:
                assert str(error).isprintable()
                continue
            submit(desk.folder.root, options)
            _check_nothing_else_ran(desk, root)
    assert list(desk.here.iterdir()) == []


@pytest.mark.parametrize("setup", [
    "source_me 'x", 'source_me "', "source_me \\", "if true", "cat <<EOF", "source_me )", "x() {",
    "case x in", "source_me \x1b[2J", "a\x00b", "source_me `", "source_me\r",
])  # fmt: skip
def test_setup_that_would_break_the_script_is_refused(setup: str) -> None:
    with pytest.raises(InputError, match=r"--setup.*source \.venv/bin/activate") as caught:
        SlurmOptions(setup=setup)
    assert str(caught.value).isprintable()


def test_setup_is_run_before_the_units(desk: Desk) -> None:
    submit(desk.folder.root, SlurmOptions(setup="source_me 'a b' # and no more\nsource_me c"))
    called = [command for command in desk.commands() if command[0] not in ("sbatch", "squeue")]
    ours = [["source_me", "a b"], ["source_me", "c"]]
    root = str(desk.folder.root)
    units, collect = _expected(root)[:2], _expected(root)[2:]
    assert called == [*ours, units[0], *ours, units[1], *ours, *collect]


def test_a_relative_folder_that_looks_like_an_option_is_accepted(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(desk.folder.root.parent)
    desk.folder.root.rename("-h")
    try:
        submit(Path("-h"), SlurmOptions())
        jobs = [command[-1] for command in desk.commands() if command[0] == "sbatch"]
        assert len(jobs) == 2 and all(Path(job).is_absolute() for job in jobs)
    finally:
        Path("-h").rename(desk.folder.root)


def _directives(script: Path) -> dict[str, str | None]:
    """Parse the #SBATCH directives as Slurm does, up to the first command and with values unquoted."""
    found: dict[str, str | None] = {}
    for line in script.read_text().splitlines():
        if not line.startswith("#"):
            break
        if line.startswith("#SBATCH "):
            (word,) = shlex.split(line.removeprefix("#SBATCH "), comments=True)
            name, separator, value = word.removeprefix("--").partition("=")
            found[name] = value if separator else None
    return found


def test_a_plan_longer_than_an_array_is_split_completely(tmp_path: Path) -> None:
    """Indices of each array start at 0, because Slurm's largest index is MaxArraySize - 1."""
    root = plan_small(tmp_path / "set", tmp_path / "library", 5, num_views=1).root
    *arrays, collect = submit(root, SlurmOptions(max_array=3), dry_run=True).scripts
    assert [path.name for path in (*arrays, collect)] == [
        *(f"units-{k}.sbatch" for k in range(3)),
        "collect.sbatch",
    ]
    found = []
    for path in arrays:
        text = path.read_text()
        (spec,), (offset,) = re.findall(r"--array=(\S+)", text), re.findall(r"unit=\$\(\((\d+) \+", text)
        found.append((spec, int(offset)))
    assert found == [("0-1", 0), ("0-1", 2), ("0", 4)]


def test_the_collecting_job_has_separate_resources(planned: DatasetFolder) -> None:
    options = SlurmOptions(cpus=16, gpus=4, memory="200G", partition="gpu", constraint="a100", account="me")
    scripts = submit(planned.root, options, dry_run=True).scripts
    units, collect = (_directives(path) for path in scripts)
    assert (units["gres"], units["cpus-per-task"], units["mem"]) == ("gpu:4", "16", "200G")
    assert units["constraint"] == "a100" and units["requeue"] is None
    assert "gres" not in collect and "constraint" not in collect
    assert (collect["cpus-per-task"], collect["mem"], collect["account"]) == ("1", "4G", "me")
    assert collect["partition"] == "gpu", "the cluster's own may not be open to this account"


def test_further_options_reach_the_right_jobs(planned: DatasetFolder) -> None:
    options = SlurmOptions(
        partition="gpu",
        qos="high",
        constraint="a100&ib",
        exclude="n[1-3],n7",
        mail_user="a@b.org",
        mail_type="END,FAIL",
        sbatch_options=("exclusive", "--gpus-per-node=a100:2", "comment=two words # not a comment"),
        collect_partition="small",
        collect_cpus=2,
        collect_options=("nice=100",),
    )
    units, collect = (_directives(path) for path in submit(planned.root, options, dry_run=True).scripts)
    for directives in (units, collect):
        assert directives["qos"] == "high" and directives["exclude"] == "n[1-3],n7"
        assert (directives["mail-user"], directives["mail-type"]) == ("a@b.org", "END,FAIL")
    assert units["constraint"] == "a100&ib" and units["exclusive"] is None
    assert units["gpus-per-node"] == "a100:2" and units["comment"] == "two words # not a comment"
    assert (collect["partition"], collect["nice"], collect["cpus-per-task"]) == ("small", "100", "2")
    assert not {"exclusive", "gpus-per-node", "comment", "constraint"} & set(collect) and "nice" not in units


def test_all_options_that_the_scripts_set_are_refused_at_once() -> None:
    with pytest.raises(InputError) as caught:
        SlurmOptions(
            sbatch_options=("array=0-5", "--output=x", "time=1"),
            collect_options=("wrap=ls",),
            cpus=0,
            qos="a b",
        )
    fields = [problem.field for problem in caught.value.problems]
    assert sorted(fields) == ["--collect-option", "--cpus", "--qos", *["--sbatch-option"] * 3]


@pytest.mark.parametrize(("failing", "code"), [("none", 0), ("status", 1), ("verify", 2), ("report", 3)])
def test_the_collecting_job_returns_its_result(desk: Desk, failing: str, code: int, tmp_path: Path) -> None:
    """Every step runs even if an earlier one fails, and the job returns the exit code of the failed step."""
    program = tmp_path / "programs" / "datagen"
    program.write_text(
        f'#!/bin/bash\necho "$*" >> {tmp_path}/steps\ncase "$*" in *{failing}*) exit {code};; esac\n'
    )
    submission = submit(desk.folder.root, SlurmOptions(), dry_run=True)
    assert subprocess.run(["/bin/bash", str(submission.scripts[-1])]).returncode == code
    assert len((tmp_path / "steps").read_text().splitlines()) == 4
