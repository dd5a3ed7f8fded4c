"""SLURM on this machine alone, with daemons of its own that end with the test.

Nothing outside the given folder is read or written: configuration, key, sockets and logs are there,
and ports are free ones. Memory is enforced by polling, as clusters do. Most callers want `slurm`.
"""

import os
import shutil
import socket
import subprocess
import time
from contextlib import ExitStack, contextmanager

import pytest

SEARCH = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
DAEMONS = ("munged", "slurmctld", "slurmd")
TOOLS = ("mungekey", "sbatch", "scancel", "sinfo", "squeue")
PATIENCE = 60  # s until the daemons must have found each other

CONFIGURATION = """
ClusterName=alone
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CryptoType=crypto/munge
SlurmctldPort={controller}
SlurmdPort={node}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
SlurmdParameters=config_overrides
ReturnToService=2
KillWait=2
SchedulerParameters=bf_interval=1,sched_min_interval=100000,batch_sched_delay=0
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=1
JobAcctGatherParams=OverMemoryKill
AccountingStorageType=accounting_storage/none
TaskProlog={folder}/prolog.sh
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory={megabytes}
PartitionName=normal Nodes={host} Default=YES MaxTime=INFINITE OverSubscribe=NO
"""

PROLOG = """#!/bin/sh
echo "export PBS_O_WORKDIR=$SLURM_SUBMIT_DIR"
[ -z "$SLURM_ARRAY_TASK_ID" ] || echo "export PBS_ARRAY_INDEX=$SLURM_ARRAY_TASK_ID"
"""  # what PBS tells a job, for scripts that come by way of SLURM's `qsub`


def program(name):
    """Path of a program, also where only root has its folder in the path; None without it."""
    return shutil.which(name, path=SEARCH)


@contextmanager
def slurm(folder, cores=2, megabytes=8000):
    """A cluster of one node; skips the test where it cannot be had.

    Parameters
    ----------
    folder : Path
        Empty, and with a short path, as sockets need.
    cores, megabytes : int
        Of the node; more than the machine has is fine.

    Yields
    ------
    environment : dict
        In which `sbatch` and the other commands reach it.
    """
    missing = [name for name in (*DAEMONS, *TOOLS) if program(name) is None]
    if missing:
        pytest.skip(f"needs SLURM and munge on this machine: no {', '.join(missing)}")
    if os.geteuid() != 0:
        pytest.skip("needs root: slurmd starts jobs for any user")
    host = socket.gethostname().split(".")[0]
    controller, node = _free_ports(2)
    terms = dict(host=host, folder=folder, controller=controller, node=node, cores=cores)
    path = folder / "slurm.conf"
    path.write_text(CONFIGURATION.format(**terms, megabytes=megabytes), encoding="ascii")
    (folder / "prolog.sh").write_text(PROLOG, encoding="ascii")
    (folder / "prolog.sh").chmod(0o755)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    environment = os.environ | {"SLURM_CONF": str(path), "PATH": SEARCH}
    key = folder / "munge.key"
    subprocess.run([program("mungekey"), "--create", f"--keyfile={key}"], check=True)
    kept = {"key-file": key, "pid-file": folder / "munged.pid", "seed-file": folder / "munge.seed"}
    kept |= {"socket": folder / "munge.socket", "log-file": folder / "munged.log"}
    munged = ["--foreground", "--force", *(f"--{name}={value}" for name, value in kept.items())]
    with ExitStack() as daemons:
        daemons.enter_context(_daemon(["munged", *munged], folder, environment))
        _wait(lambda: (folder / "munge.socket").exists(), folder)
        daemons.enter_context(_daemon(["slurmctld", "-D", "-f", path], folder, environment))
        daemons.enter_context(_daemon(["slurmd", "-D", "-f", path], folder, environment))
        _wait(lambda: "idle" in said(["sinfo", "-h", "-o", "%t"], environment), folder)
        try:
            yield environment
        finally:
            said(["scancel", "--user=root"], environment)
            wait_for_jobs(environment, PATIENCE)


def wait_for_jobs(environment, patience):
    """Wait until no job is left in the queue; fails after so many seconds."""
    end = time.monotonic() + patience
    while queue := said(["squeue", "-h", "-r", "-o", "%i %j %t %r"], environment):
        if time.monotonic() > end:
            pytest.fail(f"these jobs have not ended within {patience} s:\n{queue}")
        time.sleep(0.5)


def said(command, environment):
    """What one of SLURM's commands prints."""
    done = subprocess.run(
        [program(command[0]), *command[1:]], env=environment, capture_output=True, text=True
    )
    return done.stdout.strip()


@contextmanager
def _daemon(command, folder, environment):
    log = folder / f"{command[0]}.out"
    with open(log, "wb") as out:
        process = subprocess.Popen(
            [program(command[0]), *map(str, command[1:])],
            env=environment,
            stdout=out,
            stderr=subprocess.STDOUT,
        )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _wait(is_so, folder):
    end = time.monotonic() + PATIENCE
    while not is_so():
        if time.monotonic() > end:
            logs = "\n".join(p.read_text(errors="replace")[-2000:] for p in folder.glob("*.out"))
            pytest.fail(f"SLURM has not started within {PATIENCE} s:\n{logs}")
        time.sleep(0.2)


def _free_ports(count):
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]
