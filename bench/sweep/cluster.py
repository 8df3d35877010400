"""Execute the tasks of a sweep on a Ray cluster whose machines share a folder."""

from __future__ import annotations

import logging
import os
import re
import uuid
from collections.abc import Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from symsteer.bench.runs.config import Execution, RunConfig
from symsteer.bench.sweep.pool import SHARED_PATIENCE
from symsteer.bench.sweep.work import Kind, Result, work
from symsteer.errors import UserError
from symsteer.extras import extra
from symsteer.files import away
from symsteer.registry import ALLOWED

CONNECT_SECONDS = 10
"""How long to wait for an answer from an address."""

ADDRESS = re.compile(r"auto|(\[[0-9a-fA-F:]+\]|[^:/\s]+):[0-9]{1,5}")


class RayCluster:
    """Tasks on a cluster: one processor and one thread each, and a GPU if the run uses CUDA.

    Args:
        address: ``auto`` for the cluster that this machine belongs to, or ``host:port`` of its
            head.
        out: folder of the runs; every machine must see it under the same path.
        capacity: largest number of tasks at the same time; None: as many as fit on the cluster.

    Raises:
        UserError: if Ray is not installed, no cluster answers, or a machine does not see ``out``.
    """

    patience = SHARED_PATIENCE

    def __init__(self, address: str, out: Path, capacity: int | None):
        self.capacity = capacity
        self._ray = _connect(address)
        self._references: dict[Future, Any] = {}
        try:
            _check_shared(self._ray, out)
        except BaseException:
            self.stop()
            raise

    def submit(self, kind: Kind, configs: Sequence[RunConfig], how: Execution) -> Future:
        cuda = any("cuda" in (config.sim, config.device) for config in configs)
        remote = self._ray.remote(num_cpus=1, num_gpus=int(cuda), max_retries=0)(work)
        reference = remote.remote(kind, configs, how, self.patience)
        future = reference.future()
        self._references[future] = reference
        return future

    def result(self, future: Future) -> list[Result]:
        del self._references[future]
        errors = self._ray.exceptions
        try:
            return future.result()
        except errors.OutOfMemoryError:
            result = Result("failed", "Ray ended its process because memory ran out")
        except errors.RayTaskError as error:
            result = Result("failed", f"Ray could not run it: {_first_line(error)}", str(error))
        except errors.WorkerCrashedError as error:
            result = Result("failed", f"its process died: {_first_line(error)}")
        except errors.RayError as error:
            result = Result("lost", _first_line(error))
        return [result]

    def stop(self) -> None:
        for reference in self._references.values():
            self._ray.cancel(reference, force=True)
        self._references.clear()
        self._ray.shutdown()


def check_address(address: str) -> None:
    """Check the form of a cluster's address, without connecting to it.

    Raises:
        UserError: if it is neither ``auto`` nor ``host:port``.
    """
    if not ADDRESS.fullmatch(address):
        raise UserError(
            f"--ray {address} is not an address; use auto or the host:port of a Ray head"
        )


def _connect(address: str) -> Any:
    """The ray module, connected."""
    check_address(address)
    # Ray reads it when it is imported.
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    with extra("ray", "--ray"):
        import ray
    if address != "auto" and not os.environ.get("RAY_USE_TLS"):
        _wait_for_answer(address)
    # What was consented to on this machine holds on the others.
    allowed = {"env_vars": {ALLOWED: os.environ[ALLOWED]}} if ALLOWED in os.environ else None
    try:
        # Ray lets its workers import from the current folder.
        with away():
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR, runtime_env=allowed)
    except (ConnectionError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        raise UserError(
            f"the Ray cluster at {address} cannot be joined ({_first_line(error)}); start one with "
            "`ray start --head`"
        ) from error
    return ray


def _wait_for_answer(address: str) -> None:
    """Fail after a few seconds if no Ray head answers; Ray itself would wait for minutes."""
    import grpc

    with grpc.insecure_channel(address) as channel:
        try:
            grpc.channel_ready_future(channel).result(timeout=CONNECT_SECONDS)
        except grpc.FutureTimeoutError as error:
            raise UserError(
                f"no Ray cluster answers at {address}; start one with `ray start --head`, or check "
                "the address"
            ) from error


def _check_shared(ray: Any, out: Path) -> None:
    """Check that every machine of the cluster sees the files of this machine in a folder."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    nodes = [n for n in ray.nodes() if n["Alive"] and n["Resources"].get("CPU", 0) >= 1]
    if not nodes:
        raise UserError("the Ray cluster has no processor; add a machine with `ray start`")
    token = out / f".token-{uuid.uuid4().hex}"
    token.touch()
    try:
        answers = {}
        for node in nodes:
            there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            remote = ray.remote(num_cpus=1, max_retries=0, scheduling_strategy=there)(_sees)
            answers[node["NodeManagerAddress"], node["NodeID"]] = remote.remote(token)
        for (address, _), answer in answers.items():
            try:
                seen = ray.get(answer)
            except ray.exceptions.RayError as error:
                raise UserError(
                    f"the machine {address} of the Ray cluster cannot run SymSteer "
                    f"({_first_line(error)}); install the same version there"
                ) from error
            if not seen:
                raise UserError(
                    f"the folder {out} is not shared: {address} of the Ray cluster does not see "
                    "the same files there; choose one that all machines mount with --runs"
                )
    finally:
        token.unlink()


def _sees(path: Path) -> bool:
    """Whether a machine sees a file. A function of this module, so it asks for SymSteer there."""
    return path.is_file()


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
