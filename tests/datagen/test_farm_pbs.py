# SPDX-License-Identifier: MIT
"""The PBS engine: its scripts run under bash with a substitute ``qsub``."""

from __future__ import annotations

import os
import re
import stat
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

from datagen.cli import app
from datagen.farm.engine import job_name
from datagen.farm.folder import DatasetFolder
from datagen.farm.job_options import SlurmOptions, seconds_of
from datagen.farm.submission import cancel, submit
from datagen.foundation.errors import InputError
from tests.datagen.small_plan import plan_small
from tests.datagen.test_farm_submit import HOSTILE

_QSUB = r"""#!/bin/bash
# Runs each member of the script's array, or of one from standard input, with PBS's variables. If LATE is set,
# a script from standard input runs as job 8 when another job that depends on it is submitted.
printf '%s\n' "qsub $*" >> "$NOTES"
while [ $# -gt 0 ]; do
    case "$1" in
        -v) export "$2"; shift 2 ;;
        -W) [[ "$2" = *:8.server ]] && mv "$NOTES.late" "$NOTES.now" && bash "$NOTES.now"; shift 2 ;;
        *) break ;;
    esac
done
if [ $# -gt 0 ]; then script=$(cat "$1"); else script=$(cat); fi
if [ $# = 0 ] && [ -n "${LATE:-}" ]; then
    printf '%s\n' "export DATAGEN_UNIT=$DATAGEN_UNIT" "$script" > "$NOTES.late"
    echo "8.server"
    exit
fi
last=$(sed -n 's/^#PBS -J 0-\([0-9]*\).*/\1/p' <<< "$script")
for member in $(seq 0 "${last:-0}"); do
    if [ -n "$last" ]; then export PBS_ARRAY_INDEX=$member; else unset PBS_ARRAY_INDEX; fi
    bash <(printf '%s\n' "$script") || true
done
echo "7.server"
"""
_DATAGEN = r"""#!/bin/bash
printf '%s\n' "datagen $*" >> "$NOTES"
[ "$3" = --unit ] && [ "$4" = "${SLOW_UNIT:-}" ] && [ ! -e "$NOTES.slow" ] || exit 0
touch "$NOTES.slow"
trap 'exit 75' USR1
for k in $(seq 100); do sleep 0.1; done
"""
_QSELECT = r"""#!/bin/bash
printf '%s\n' "qselect $*" >> "$NOTES"
[[ "$2" = datagen-* && -e "$NOTES.late" ]] && echo "8.server"
[ -z "$ANSWER" ] || echo $ANSWER
"""
_QDEL = '#!/bin/bash\nprintf \'%s\\n\' "qdel $*" >> "$NOTES"\n'


@dataclass
class Desk:
    """A planned folder, and the calls that the substitute commands recorded in ``notes``."""

    folder: DatasetFolder
    notes: Path

    def lines(self) -> list[str]:
        text = self.notes.read_text() if self.notes.exists() else ""
        self.notes.unlink(missing_ok=True)
        return text.splitlines()


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Desk:
    programs = tmp_path / "programs"
    programs.mkdir()
    texts = {"qsub": _QSUB, "datagen": _DATAGEN, "qselect": _QSELECT, "qdel": _QDEL}
    for name, text in texts.items():
        path = programs / name
        path.write_text(text)
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{programs}:/usr/bin:/bin")
    monkeypatch.setenv("NOTES", str(tmp_path / "notes"))
    monkeypatch.setenv("ANSWER", "")
    return Desk(plan_small(tmp_path / "set", tmp_path / "library", 3), tmp_path / "notes")


def _pretend_done(desk: Desk, monkeypatch: pytest.MonkeyPatch, *indices: int) -> None:
    monkeypatch.setattr(DatasetFolder, "is_done", lambda self, unit: unit.index in indices)


def test_members_run_the_unfinished_units(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    _pretend_done(desk, monkeypatch, 1)
    root = desk.folder.root
    done = submit(root, SlurmOptions(), "pbs")
    assert done.num_units == 2 and done.job_ids == ("7.server", "7.server")
    called = desk.lines()
    assert called[0] == f"qselect -N {job_name(root)}"
    assert [line for line in called if line.startswith("datagen")] == [
        f"datagen run {root} --unit 0 --attempts 3",
        f"datagen run {root} --unit 2 --attempts 3",
        f"datagen farm status {root}",
        f"datagen run {root} --only index --deep",
        f"datagen verify {root} --workers 1",
        f"datagen report {root} --workers 1",
    ]
    assert f"qsub -W depend=afterany:7.server {root}/jobs/collect.pbs" in called


def test_a_single_unit_needs_no_array(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """PBS refuses arrays of a single member."""
    _pretend_done(desk, monkeypatch, 0, 1)
    submit(desk.folder.root, SlurmOptions(), "pbs")
    assert "-J" not in (desk.folder.root / "jobs" / "units-0.pbs").read_text().replace("'^#PBS -J'", "")
    assert f"datagen run {desk.folder.root} --unit 2 --attempts 3" in desk.lines()


def test_long_plans_become_several_arrays(desk: Desk) -> None:
    done = submit(desk.folder.root, SlurmOptions(max_array=2, throttle=5), "pbs", dry_run=True)
    assert [path.name for path in done.scripts] == ["units-0.pbs", "units-1.pbs", "collect.pbs"]
    assert "#PBS -J 0-1%5\n" in done.scripts[0].read_text()


def test_interrupted_jobs_resubmit_themselves(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """The slow unit is signalled two seconds before its limit of four, stops, and is submitted again."""
    monkeypatch.setenv("SLOW_UNIT", "1")
    root = desk.folder.root
    submit(root, SlurmOptions(time_limit="0:04", notice_s=2), "pbs")
    called = desk.lines()
    assert called.count(f"datagen run {root} --unit 1 --attempts 3") == 2
    assert called.count(f"datagen run {root} --unit 0 --attempts 3") == 1
    assert "qsub -v DATAGEN_UNIT=1" in called


def test_units_that_resubmit_themselves_are_collected(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """The index is written after an interrupted unit, whose new job starts only when the array has ended."""
    monkeypatch.setenv("SLOW_UNIT", "1")
    monkeypatch.setenv("LATE", "1")
    root = desk.folder.root
    submit(root, SlurmOptions(time_limit="0:04", notice_s=2), "pbs")
    called = [line for line in desk.lines() if line.startswith("datagen run")]
    unit, index = f"datagen run {root} --unit 1 --attempts 3", f"datagen run {root} --only index --deep"
    assert called[1:] == [unit, f"datagen run {root} --unit 2 --attempts 3", unit, index]


def test_directives_match_the_options(desk: Desk) -> None:
    options = SlurmOptions(
        time_limit="1-02:30",
        memory="8G",
        cpus=6,
        gpus=1,
        partition="gpuq",
        account="lab",
        mail_user="a@b.org",
    )
    scripts = submit(desk.folder.root, options, "pbs", dry_run=True).scripts
    directives = re.findall(r"^#PBS (.*)$", scripts[0].read_text(), re.M)
    assert "-l select=1:ncpus=6:mem=8gb:ngpus=1" in directives
    assert {"-l walltime=26:30:00", "-q gpuq", "-A lab", "-M a@b.org", "-r y"} <= set(directives)
    collecting = re.findall(r"^#PBS (.*)$", scripts[-1].read_text(), re.M)
    assert "-l select=1:ncpus=1:mem=4gb" in collecting


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("90", 5400),
        ("2:30", 150),
        ("04:00:00", 14400),
        ("1-12", 129600),
        ("1-02:30", 95400),
        ("2-0:0:05", 172805),
    ],
)
def test_times_are_parsed(text: str, seconds: int) -> None:
    assert seconds_of(text) == seconds


def test_all_options_without_pbs_equivalents_are_refused_at_once(desk: Desk) -> None:
    options = SlurmOptions(qos="high", sbatch_options=("exclusive",), time_limit="1", notice_s=90)
    with pytest.raises(InputError) as caught:
        submit(desk.folder.root, options, "pbs")
    problems = [f"{p.field}: {p.expected}" for p in caught.value.problems]
    assert problems == [
        "--qos: nothing: PBS does not support it",
        "--sbatch-option: nothing: PBS does not support it",
        "--notice: less than --time 1",
    ]


@pytest.mark.parametrize("name", HOSTILE, ids=[ascii(name) for name in HOSTILE])
def test_hostile_folder_names_execute_nothing(name: str, desk: Desk, tmp_path: Path) -> None:
    root = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + os.fsencode(name)))
    root.parent.mkdir(parents=True, exist_ok=True)
    desk.folder.root.rename(root)
    try:
        scripts = submit(root, SlurmOptions(), "pbs", dry_run=True).scripts
    except InputError:
        assert re.search(r"[\x00-\x1f\x7f-\x9f\u2028\udc80]", name), f"{name!r} needs no refusal"
        return
    for script in scripts:
        subprocess.run(["bash", "-n", str(script)], check=True)
    here = tmp_path / "here"
    here.mkdir()
    subprocess.run(
        ["bash", str(scripts[0])], cwd=here, env={**os.environ, "PBS_ARRAY_INDEX": "1"}, check=True
    )
    assert desk.lines() == [f"datagen run {root.resolve()} --unit 1 --attempts 3"]
    assert list(here.iterdir()) == []


def test_cancelling_finds_jobs_by_name(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ANSWER", "7[].server 9.server")
    assert cancel(desk.folder.root, "pbs") == ["7[].server", "9.server"]
    name = job_name(desk.folder.root)
    assert desk.lines() == [
        f"qselect -N {name}",
        f"qselect -N collect-{name}",
        "qdel 7[].server 9.server",
    ]
    with pytest.raises(InputError, match=r"jobs = 2 in the queue; expected none of this folder"):
        submit(desk.folder.root, SlurmOptions(), "pbs")


def test_unknown_engines_are_refused(desk: Desk) -> None:
    result = CliRunner().invoke(app, ["farm", "submit", str(desk.folder.root), "--engine", "lsf"])
    assert isinstance(result.exception, InputError)
    assert "engine = lsf; expected slurm, pbs, shell" in str(result.exception)
