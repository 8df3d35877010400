"""Hand the runs of a sweep to Slurm: an array, each task of which is ``symsteer sweep --shard``.

The command submits the array and ends. Each task is a sweep of its own on its node. Slurm warns it
before its time is over; it then stops, and its runs keep their last checkpoints. The lines behind
the work in the batch script queue it again: there is no ``scontrol`` in a container.

submitit writes the batch script and starts the tasks. It would learn their states from the
accounting database, and without one it answers ``UNKNOWN``. So the queue itself is asked.
"""

from __future__ import annotations

import contextlib
import io
import os
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, field_validator

from symsteer.bench.runs.folder import CHECKPOINT
from symsteer.bench.sweep.array_task import AGAIN, ArrayTask
from symsteer.bench.sweep.command import look_at, preview, workers_of
from symsteer.bench.sweep.grid import read_suite
from symsteer.bench.sweep.plan import Plan, read_sweep, shares, sweep_path, write_sweep
from symsteer.bench.sweep.workforce import Workforce
from symsteer.errors import UserError
from symsteer.extras import extra
from symsteer.files import prepare_folder, read_model, write_atomically
from symsteer.terminal import to_paste

LAUNCHERS = Path(__file__).parent.parent / "launchers"

NOTICE_SECONDS = 90
"""How long before the end of its time a task is warned."""

REQUEUE = f"code=$?; if [ $code = {AGAIN} ]; then scontrol requeue $SLURM_JOB_ID; fi; exit $code"


class SlurmFile(BaseModel):
    """What a task of the array asks for; ``bench/launchers/slurm.toml`` explains the keys."""

    model_config = ConfigDict(extra="forbid", strict=True)

    partition: str | None = None
    time: str = "4:00:00"
    memory: str = "16G"
    cpus: int = Field(8, ge=1)
    gpus: int = Field(0, ge=0)
    runs: int | None = Field(None, ge=1)
    at_once: int | None = Field(None, ge=1)
    image: str | None = None
    setup: list[str] = []
    sbatch: dict[str, str | int | bool] = {}

    @field_validator("sbatch")
    @classmethod
    def _of_others(cls, options: dict[str, Any]) -> dict[str, Any]:
        own = {"array", "job-name", "signal", "output", "error", "open-mode", "requeue", "nodes"}
        if taken := own & {key.replace("_", "-") for key in options}:
            raise ValueError(f"{min(taken)} is set by SymSteer; leave it out")
        return options


def launch(
    plan: Plan, suite: str, launcher: str, workforce: Workforce, more: tuple[str, ...], dry: bool
) -> str:
    """Queue the runs of a suite that are neither finished nor queued, as one array.

    Args:
        plan: of the whole suite.
        suite, launcher: names or paths of their files.
        workforce: of each task.
        more: words of the command line for each task.
        dry: only say what would be done.

    Returns:
        What was done, as text.

    Raises:
        UserError: if a file or number is wrong, there is no Slurm, or it refuses the array.
    """
    file = read_model(launcher, "launcher", LAUNCHERS, SlurmFile)[0]
    if workforce.ray is not None or plan.part:
        raise UserError("--launcher shares out the runs itself; leave --ray and --shard out")
    workers, together = workers_of(workforce, plan, file.cpus) or 1, workforce.together or 1
    count = -(-len(plan.runs) // (file.runs or workers * together))
    at_once = workers * min(count, file.at_once or count)
    if dry:
        would = f"an array of up to {count} tasks, each with {workers} runs at a time"
        return f"{preview(plan, replace(workforce, workers=at_once))}\nSlurm: {would}"
    unfinished = [run for run, sighting in look_at(plan).items() if sighting.state != "finished"]
    jobs: dict[str, str] = {}
    # Without one, nothing was launched.
    with contextlib.suppress(UserError):
        jobs = read_sweep(plan.path).jobs
    left = jobs_left(plan.out, plan.name, jobs)
    jobs = {run_id: jobs[run_id] for run_id in left if left[run_id] is None}
    todo = {run for run in unfinished if run.run_id not in jobs}
    before, waiting = len(plan.runs) - len(unfinished), len(unfinished) - len(todo)
    text = f"{before} runs finished, {waiting} in the queue before, {len(todo)} queued now"
    tasks = {
        f"{number}/{count}": share.runs
        for number, share in enumerate(shares(plan, count), 1)
        if not todo.isdisjoint(share.runs)
    }
    if tasks:
        words = ("sweep", _kept(suite, plan, bool(jobs)), "--runs", str(plan.out), *more)
        words += ("--workers", str(workers), "--together", str(together), "--shard")
        array = []
        for shard, runs in tasks.items():
            checkpoints = tuple(plan.out / run.run_id / CHECKPOINT for run in runs)
            array.append(ArrayTask((*words, shard), checkpoints, plan.out / "base"))
        names = _submit(array, plan, file)
        for name, runs in zip(names, tasks.values(), strict=True):
            jobs |= {run.run_id: name for run in runs}
        write_sweep(plan, at_once, {}, jobs)
        text += f" as array {names[0].partition('_')[0]} of {len(tasks)}"
    return f"{text}\nhow far they are: {to_paste('symsteer', 'status', plan.out)}"


def jobs_left(out: Path, suite: str, jobs: Mapping[str, str]) -> dict[str, Path | None]:
    """Of the jobs of runs, by run id: None if Slurm still has them, otherwise their output's file.

    Raises:
        UserError: if Slurm does not answer here.
    """
    if not jobs:
        return {}
    command = ["squeue", "--noheader", "--array", "--format=%i", f"--name={_job_name(suite)}"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    except FileNotFoundError as error:
        raise _no_slurm("squeue") from error
    except (subprocess.SubprocessError, OSError) as error:
        reason = getattr(error, "stderr", "") or str(error)
        raise UserError(f"Slurm does not answer ({_line(reason)}); try again later") from error
    left, folder = set(done.stdout.split()), _folder(out, suite)
    return {
        run_id: None if job in left else folder / f"{job}_0_log.out" for run_id, job in jobs.items()
    }


def _submit(tasks: Sequence[ArrayTask], plan: Plan, file: SlurmFile) -> list[str]:
    """The names of the jobs of an array."""
    with extra("slurm", "--launcher"):
        import submitit
    python = None
    if file.image is not None:
        if not Path(file.image).is_file():
            raise UserError(f"there is no image {file.image}; correct `image`, or leave it out")
        words = ["apptainer", "exec", *(["--nv"] if file.gpus else []), "--bind", str(plan.out)]
        python = shlex.join([*words, os.path.abspath(file.image), "python"])
    folder = _folder(plan.out, plan.name)
    prepare_folder(folder)
    try:
        executor = submitit.SlurmExecutor(folder, python=python)
    except RuntimeError as error:
        raise _no_slurm("srun") from error
    executor.update_parameters(
        job_name=_job_name(plan.name),
        partition=file.partition,
        time=file.time,
        mem=file.memory,
        cpus_per_task=file.cpus,
        # From Slurm 22.05 on, srun does not know the number from sbatch.
        srun_args=[f"--cpus-per-task={file.cpus}"],
        gpus_per_node=file.gpus or None,
        array_parallelism=file.at_once or len(tasks),
        signal_delay_s=NOTICE_SECONDS,
        stderr_to_stdout=True,
        # Nothing is imported from the folder that the command was given in.
        setup=["export PYTHONSAFEPATH=1", *file.setup],
        teardown=[REQUEUE],
        additional_parameters={**file.sbatch, "requeue": True},
    )
    own = {key: os.environ[key] for key in os.environ if key.startswith(("SBATCH_", "SLURM_CONF"))}
    try:
        # Nothing of the interactive job in which the command may be given.
        with submitit.helpers.clean_env(), contextlib.redirect_stderr(io.StringIO()):
            os.environ |= own
            jobs = executor.submit_array(tasks)
    except (submitit.core.utils.FailedJobError, RuntimeError) as error:
        raise UserError(
            f"Slurm refuses the array ({_line(str(error))}); correct the launcher's file"
        ) from error
    return [job.job_id for job in jobs]


def _kept(suite: str, plan: Plan, in_use: bool) -> str:
    """The path of a copy of a suite for the tasks: the user may edit the suite meanwhile."""
    path = plan.path.with_suffix(".toml")
    text = read_suite(suite)[1].read_bytes()
    if not path.is_file() or path.read_bytes() != text:
        if in_use:
            raise UserError(
                f"the suite {plan.name} has changed since it was queued; wait for its jobs, or end "
                f"them with: scancel --name {_job_name(plan.name)}"
            )
        write_atomically(path, text)
    return str(path)


def _folder(out: Path, suite: str) -> Path:
    return sweep_path(out, suite).with_name(f"{suite}-slurm")


def _job_name(suite: str) -> str:
    return f"symsteer-{suite}"


def _no_slurm(command: str) -> UserError:
    return UserError(
        f"this machine has no Slurm ({command} is not found); give the command on a login node"
    )


def _line(text: str) -> str:
    """The last line of what a command of Slurm complains of."""
    return (text.strip().splitlines() or ["it gives no reason"])[-1]
