# SPDX-License-Identifier: MIT
"""A real Slurm on one machine for tests: munged, slurmctld and several slurmd, without systemd or cgroups.

All files are in a temporary folder, and leaving the context manager ends all processes. The settings were
found by experiment: nodes are declared down quickly, requeues do not wait two minutes, and signals reach
preempted steps.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import psutil

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scontrol", "scancel", "sinfo")
_PATH = os.environ.get("PATH", "") + ":/usr/sbin:/sbin"


def missing_programs() -> list[str]:
    """Return the programs of Slurm and munge that are not installed (Debian: slurm-wlm, munge)."""
    return [name for name in PROGRAMS if shutil.which(name, path=_PATH) is None]


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    try:
        for opened in sockets:
            opened.bind(("127.0.0.1", 0))
        return [opened.getsockname()[1] for opened in sockets]
    finally:
        for opened in sockets:
            opened.close()


class Cluster:
    """A context manager that runs a cluster of ``num_nodes`` nodes with ``cpus`` processors each.

    ``environment`` contains the environment variables by which commands reach it.
    """

    def __init__(self, root: Path, num_nodes: int = 3, cpus: int = 2):
        self.root = root
        self.num_nodes = num_nodes
        self.cpus = cpus
        self.config = root / "slurm.conf"
        self.environment = {**os.environ, "PATH": _PATH, "SLURM_CONF": str(self.config)}
        self._munged: subprocess.Popen | None = None
        self._controller: subprocess.Popen | None = None
        self._nodes: dict[str, subprocess.Popen] = {}

    @property
    def node_names(self) -> list[str]:
        return [f"n{number + 1}" for number in range(self.num_nodes)]

    def __enter__(self) -> Cluster:
        try:
            self._write_config()
            self._start_munge()
            self.start_controller()
            for name in self.node_names:
                self.start_node(name)
            self.wait_for(lambda: self.states().count("idle") == self.num_nodes, "idle nodes")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        for name in list(self._nodes):
            self.kill_node(name, and_jobs=True)
        for process in (self._controller, self._munged):
            if process is not None and process.poll() is None:
                process.kill()
                process.wait()

    def _write_config(self) -> None:
        host = socket.gethostname()
        controller, *ports = _free_ports(1 + self.num_nodes)
        for name in ("state", "munge", "log", *(f"spool.{node}" for node in self.node_names)):
            (self.root / name).mkdir(parents=True)
        (self.root / "munge").chmod(0o700)
        nodes = "\n".join(
            f"NodeName={name} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} CPUs={self.cpus} "
            "RealMemory=16000 State=UNKNOWN"
            for name, port in zip(self.node_names, ports, strict=True)
        )
        self.config.write_text(f"""\
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=cred_expire=5,socket={self.root}/munge/munge.sock
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
SlurmctldParameters=preempt_send_user_signal
SchedulerParameters=sched_interval=1,bf_interval=1
SlurmdTimeout=10
SlurmctldTimeout=10
InactiveLimit=0
KillWait=5
MinJobAge=60
ReturnToService=2
MaxArraySize=1001
StateSaveLocation={self.root}/state
SlurmdSpoolDir={self.root}/spool.%n
SlurmctldPidFile={self.root}/slurmctld.pid
SlurmdPidFile={self.root}/slurmd.%n.pid
SlurmctldLogFile={self.root}/log/slurmctld.log
SlurmdLogFile={self.root}/log/slurmd.%n.log
{nodes}
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP OverSubscribe=NO
""")

    def _start_munge(self) -> None:
        key = self.root / "munge" / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        self._munged = subprocess.Popen(
            [
                "munged",
                "--foreground",
                "--force",
                f"--key-file={key}",
                f"--socket={self.root}/munge/munge.sock",
                f"--pid-file={self.root}/munge/munged.pid",
                f"--log-file={self.root}/munge/munged.log",
                f"--seed-file={self.root}/munge/munged.seed",
            ],
            env=self.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self.wait_for((self.root / "munge" / "munge.sock").exists, "munge's socket")

    def start_controller(self) -> None:
        """Start slurmctld, or restart it after :meth:`kill_controller`."""
        self._controller = self._daemon("slurmctld", "-D", "-f", str(self.config))

    def kill_controller(self) -> None:
        """Kill slurmctld as a crash would."""
        assert self._controller is not None
        self._controller.kill()
        self._controller.wait()

    def start_node(self, name: str) -> None:
        """Start the slurmd of a node, or restart it after :meth:`kill_node`."""
        self._nodes[name] = self._daemon("slurmd", "-D", "-f", str(self.config), "-N", name)

    def kill_node(self, name: str, and_jobs: bool) -> None:
        """Kill a node's slurmd; without ``and_jobs`` its jobs continue, as after a network failure."""
        process = self._nodes.pop(name, None)
        if process is None:
            return
        spool = str(self.root / f"spool.{name}")
        process.kill()
        process.wait()
        if not and_jobs:
            return
        for candidate in psutil.process_iter(["cmdline", "name"]):
            command = " ".join(candidate.info["cmdline"] or [])
            is_step = (candidate.info["name"] or "").startswith("slurmstepd")
            if spool in command or (is_step and self._belongs(candidate)):
                _kill_tree(candidate)

    def leftovers(self) -> list[str]:
        """Return the remaining processes of this cluster and its jobs."""
        found = []
        for process in psutil.process_iter(["pid", "cmdline"]):
            command = " ".join(process.info["cmdline"] or [])
            if str(self.root) in command or (process.pid != os.getpid() and self._belongs(process)):
                found.append(f"{process.pid} {command}")
        return found

    def _belongs(self, process: psutil.Process) -> bool:
        try:
            return process.environ().get("SLURM_CONF") == str(self.config)
        except psutil.Error:
            return False

    def _daemon(self, *command: str) -> subprocess.Popen:
        log = (self.root / "log" / f"{command[0]}.{command[-1].replace('/', '_')}.out").open("ab")
        with log:
            return subprocess.Popen(command, env=self.environment, stdout=log, stderr=log)

    def run(self, *command: str) -> str:
        """Return the output of a Slurm command. Raises RuntimeError with its message if it fails."""
        result = subprocess.run(command, env=self.environment, capture_output=True, text=True, timeout=60)
        if result.returncode != 0:
            raise RuntimeError(f"{' '.join(command)}: {result.stderr or result.stdout}")
        return result.stdout

    def states(self) -> list[str]:
        try:
            return self.run("sinfo", "--noheader", "-N", "-o", "%t").split()
        except RuntimeError:
            return []  # the controller is still starting

    def jobs(self) -> list[str]:
        """Return the lines ``id state reason`` of the queue, one per array task."""
        return self.run("squeue", "--noheader", "-r", "--format=%i %T %r").splitlines()

    def wait_for(self, condition: Callable[[], object], what: str, timeout_s: float = 90.0) -> None:
        """Poll until ``condition()`` is true. Raises TimeoutError with the queue after ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                queue = self.jobs() if self._controller and self._controller.poll() is None else []
                raise TimeoutError(f"waited {timeout_s} s for {what}; queue: {queue}")
            signal.sigtimedwait([], 0.2)

    def wait_until_stuck_or_idle(self) -> bool:
        """Wait until no job runs or can start; return True if jobs remain in the queue."""
        self.wait_for(lambda: all(_is_stuck(job) for job in self.jobs()), "an empty or a stuck queue", 240.0)
        return bool(self.jobs())

    def resume_nodes(self) -> None:
        """Resume drained nodes, as an administrator does once their jobs have ended."""
        for line in self.run("sinfo", "--noheader", "-N", "-o", "%N %t").splitlines():
            name, state = line.split()
            if state.startswith("dr"):
                self.run("scontrol", "update", f"NodeName={name}", "State=RESUME")

    def wait_until_idle(self, timeout_s: float = 240.0) -> None:
        """Wait until the queue is empty."""
        self.wait_for(lambda: not self.jobs(), "an empty queue", timeout_s)


def _is_stuck(job: str) -> bool:
    """Return whether a line of :meth:`Cluster.jobs` is a job that is held or waits for another job."""
    return job.endswith("held") or " PENDING Dependency" in job


def _kill_tree(process: psutil.Process) -> None:
    try:
        family = [*process.children(recursive=True), process]
    except psutil.Error:
        return  # the process has ended
    for member in family:
        try:
            member.kill()
        except psutil.Error:
            continue  # the process has ended
