"""Runs the parts of a command side by side: on the cores of one machine, or on a cluster by Slurm.

Every long command here takes `--shard I/N` and makes the I-th of N parts: `wlplan collect` and the
experiments whose rows are files. A part that was cut short goes on when it is started again. So all
that is left to do is to start N of them, which submitit does:

    python -m experiments._common.spread --jobs 8 --cluster slurm --hours 12 \
        -- python -m experiments.hyperparameters --whole

`{}` in a word of the command becomes the number of the part, from 1 on.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments._common.places import say
from wlplan.errors import InputError
from wlplan.xla import cores

if TYPE_CHECKING:
    import submitit

LOGS = Path("out") / "spread"
CLUSTERS = ("local", "slurm")
# How often a job whose time is over is queued again.
_MOST_TIMES = 100
# Between two looks at how the jobs are [s].
_LOOK = 1.0


@dataclasses.dataclass(frozen=True)
class Part:
    """A part of a command, as a job runs it.

    Attributes:
        words: The command.
        core_numbers: Cores that it may use; empty: those that the scheduler gives it.
    """

    words: tuple[str, ...]
    core_numbers: tuple[int, ...] = ()

    def __call__(self) -> int:
        """Runs it; returns its exit code."""
        if self.core_numbers and hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, self.core_numbers)
        return subprocess.run(self.words, check=False).returncode

    def checkpoint(self) -> Any:
        """What is to be submitted when the time of the job is over: the same, which goes on."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def parts(command: Sequence[str], jobs: int) -> list[tuple[str, ...]]:
    """The commands of all parts.

    Args:
        command: Words of the command.
        jobs: How many parts there are.
    """
    return [
        (*(word.replace("{}", str(number)) for word in command), "--shard", f"{number}/{jobs}")
        for number in range(1, jobs + 1)
    ]


def start(
    command: Sequence[str],
    jobs: int,
    *,
    cluster: str = "local",
    cores_each: int = 1,
    logs: Path = LOGS,
    hours: float = 24.0,
    memory: float = 8.0,
    slurm: dict[str, str] | None = None,
) -> list[submitit.Job[int]]:
    """Starts all parts of a command.

    Args:
        command: Words of a command that takes `--shard I/N`.
        jobs: How many parts.
        cluster: One of `CLUSTERS`.
        cores_each: Cores of a part.
        logs: Folder of what the parts say, and of what submitit keeps of them.
        hours: Time of a job [h]; if that is not enough, the job goes on in another one.
        memory: Memory of a job [GB]; Slurm's alone.
        slurm: Other options of Slurm, such as its partition.

    Returns:
        The jobs; the result of each is the exit code of its part.

    Raises:
        InputError: If submitit is not installed, or the machine has fewer cores.
    """
    try:
        import submitit
    except ImportError as error:
        raise InputError(
            "Parts are started by submitit, which is not installed: pip install 'wlplan[cluster]'."
        ) from error
    local = cluster == "local"
    # Those that this process may use, which need not be the first ones.
    own = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if local and jobs * cores_each > cores():
        raise InputError(
            f"{jobs} jobs of {cores_each} core{'s' if cores_each > 1 else ''} are too many for "
            f"the {cores()} of this machine: start {max(cores() // cores_each, 1)} at most."
        )
    try:
        executor = submitit.AutoExecutor(
            folder=logs, cluster=cluster, slurm_max_num_timeout=_MOST_TIMES
        )
    except RuntimeError as error:
        raise InputError("Slurm is not here: start this where `srun` can be called.") from error
    executor.update_parameters(
        name="wlplan",
        timeout_min=max(round(60.0 * hours), 1),
        cpus_per_task=cores_each,
        mem_gb=memory,
        stderr_to_stdout=True,
        **{f"slurm_{name}": value for name, value in (slurm or {}).items()},
    )
    todo = [
        Part(words, tuple(own[k * cores_each : (k + 1) * cores_each]) if local else ())
        for k, words in enumerate(parts(command, jobs))
    ]
    with executor.batch():
        return [executor.submit(part) for part in todo]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line: starts the parts and waits for them; exit code 1 if one of them failed."""
    about, _, more = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        prog="python -m experiments._common.spread",
        description=about,
        epilog=more,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--jobs", type=int, default=cores(), help="parts (default: one a core)")
    parser.add_argument("--cluster", choices=CLUSTERS, default="local")
    parser.add_argument("--cores", type=int, default=1, help="of a part (default 1)")
    parser.add_argument("--hours", type=float, default=24.0, help="time of a job (default 24)")
    parser.add_argument("--memory", type=float, default=8.0, help="of a job [GB] (default 8)")
    parser.add_argument("--logs", type=Path, default=LOGS, help=f"folder of logs (default {LOGS})")
    parser.add_argument(
        "--slurm", action="append", default=[], metavar="NAME=VALUE", help="such as partition=main"
    )
    parser.add_argument("command", nargs="+", metavar="COMMAND", help="behind --")
    options = parser.parse_args(arguments)
    if options.jobs < 1 or options.cores < 1:
        parser.error("--jobs and --cores have to be 1 or more")
    if not all("=" in word for word in options.slurm):
        parser.error("--slurm needs a name and a value: partition=main")
    try:
        jobs = start(
            options.command,
            options.jobs,
            cluster=options.cluster,
            cores_each=options.cores,
            logs=options.logs,
            hours=options.hours,
            memory=options.memory,
            slurm=dict(word.split("=", 1) for word in options.slurm),
        )
    except InputError as error:
        say(f"error: {error}")
        return 2
    for number, job in enumerate(jobs, 1):
        say(f"part {number} of {len(jobs)}: job {job.job_id}, says {job.paths.stdout}")
    return wait(jobs)


def wait(jobs: Sequence[submitit.Job[int]]) -> int:
    """Waits for jobs and says how each ended; 1 if one of them failed, else 0."""
    left = dict(enumerate(jobs, 1))
    failed = False
    while left:
        for number, job in list(left.items()):
            if job.done():
                problem = job.exception()
                code = None if problem is not None else job.result()
                failed |= code != 0
                how = "done" if code == 0 else f"failed, see {job.paths.stdout}"
                say(f"part {number} of {len(jobs)}: {how}")
                del left[number]
        if left:
            time.sleep(_LOOK)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
