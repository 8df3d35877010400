"""Work off a suite in a pool of processes: one run a process, one thread a run."""

from __future__ import annotations

import multiprocessing
import os
import time
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from bench.runs.base_policy import prepare_base
from bench.runs.config import RunConfig
from bench.runs.folder import is_finished, run_id
from bench.runs.run import check, execute
from bench.sweep.suite import Suite
from leaderboard.records import read_record
from policies.errors import UserError


@dataclass
class Outcome:
    """What became of a cell: ``finished``, ``skipped`` (finished before) or ``failed``."""

    config: RunConfig
    status: str
    detail: str = ""

    @property
    def label(self) -> str:
        """The cell in words."""
        c = self.config
        return f"{c.task} {c.embodiment} {c.variant:16s} {c.agent:16s} seed {c.seed}"


def run_suite(suite: Suite, out: Path, workers: int) -> list[Outcome]:
    """Run every cell that is not finished; a failed one does not stop the others.

    Base policies that several cells share are built first, once.

    Raises:
        UserError: if ``workers`` is not positive, or a cell names what does not exist.
        OSError: if ``out`` cannot be made.
    """
    if workers < 1:
        raise UserError(f"--workers is {workers}; it must be at least 1")
    for config in suite.runs:
        check(config)
    out.mkdir(parents=True, exist_ok=True)
    outcomes, todo = [], []
    for config in suite.runs:
        folder = out / run_id(config, {})
        if is_finished(folder):
            outcomes.append(Outcome(config, "skipped", _describe(folder)))
            print(f"  skipped   {outcomes[-1].label}  {outcomes[-1].detail}", flush=True)
        else:
            todo.append(config)
    broken: dict[tuple, str] = {}
    for config in {_base_key(c): c for c in todo}.values():
        try:
            prepare_base(config, out)
        except Exception as error:
            broken[_base_key(config)] = f"its base policy failed: {_reason(error)}"
    for config in todo:
        if _base_key(config) in broken:
            outcomes.append(Outcome(config, "failed", broken[_base_key(config)]))
    todo = [config for config in todo if _base_key(config) not in broken]
    started = time.monotonic()
    # Spawned, because forking a process that has used torch's threads can deadlock.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        workers, mp_context=context, initializer=_limit_threads, initargs=(workers,)
    ) as pool:
        futures: dict[Future[Path], RunConfig] = {
            pool.submit(execute, config, out, progress=False): config for config in todo
        }
        try:
            for done, future in enumerate(as_completed(futures), 1):
                config = futures[future]
                try:
                    outcome = Outcome(config, "finished", _describe(future.result()))
                except Exception as error:
                    outcome = Outcome(config, "failed", _reason(error))
                outcomes.append(outcome)
                left = (time.monotonic() - started) / done * (len(futures) - done)
                print(
                    f"  {outcome.status:9s} {outcome.label}  {outcome.detail}  "
                    f"[{done}/{len(futures)}, about {left / 60:.1f} min left]",
                    flush=True,
                )
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return outcomes


def _base_key(config: RunConfig) -> tuple:
    return config.task, config.embodiment, config.demonstrations, config.policy, config.policy_seed


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"


def _limit_threads(workers: int) -> None:
    import torch

    torch.set_num_threads(max(1, (os.cpu_count() or 1) // workers))


def _describe(folder: Path) -> str:
    record = read_record(folder / "record.json")
    final = record.evaluations[-1]
    success = sum(final.episodes.success_once)
    return (
        f"success {success / len(final.episodes.seed):4.0%} of {len(final.episodes.seed)}, "
        f"{record.wall_clock.total:.0f} s"
    )
