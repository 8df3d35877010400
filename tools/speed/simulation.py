"""How fast simulation is, against stock ManiSkill and against the physics alone.

Everything is measured in one run: machines differ and their speed changes, so only ratios of
numbers from the same run mean something. The contenders take turns (a b c d a b c d ...). A turn
plays whole episodes of random actions, with one reset each; its clock stops after all work is done.
"""

from __future__ import annotations

import gc
import json
import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from importlib.metadata import version
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401  (fills ManiSkill's registry)
import psutil
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

from symsteer.bench.sim.environment import MAX_SCENES
from symsteer.bench.sim.headless import prepare_headless
from symsteer.bench.sim.parallel import create, divide
from symsteer.bench.sim.shards.processes import start_process
from symsteer.bench.tasks import task_class
from symsteer.errors import UserError
from symsteer.leaderboard.records.provenance import processor_name

EPISODE = 50
"""Control steps between two resets."""

CONTROLLER = "pd_ee_delta_pose"

MIN_STOCK_RATIO, MIN_LIMIT_SHARE = 6.0, 0.55
"""Goals: speed relative to stock in as many processes, and relative to the physics alone."""

_SETTINGS: dict[str, Any] = {"obs_mode": "state", "control_mode": CONTROLLER}


@dataclass(frozen=True)
class Turn:
    """Control steps of a turn, summed over environments; its wall and processor seconds."""

    steps: int
    seconds: float
    cpu: float


@dataclass
class Row:
    """One contender's result.

    Attributes:
        letter: ``a`` stock, ``b`` stock in several processes, ``c`` ours, ``d`` physics alone,
            ``g`` ours on CUDA.
        name: for the table.
        processes: number of processes that simulate.
        num_envs: environments, summed over the processes.
        turns: one for each repeat.
    """

    letter: str
    name: str
    processes: int
    num_envs: int
    turns: list[Turn] = field(default_factory=list)

    @property
    def rates(self) -> list[float]:
        """Control steps per second of wall clock, for each turn."""
        return [turn.steps / turn.seconds for turn in self.turns]

    @property
    def median(self) -> float:
        """Median of the rates."""
        return statistics.median(self.rates)

    @property
    def cpu_rate(self) -> float:
        """Control steps per second if every process had a core for itself: by processor time."""
        return statistics.median(t.steps / t.cpu for t in self.turns) * self.processes

    def to_json(self) -> dict[str, Any]:
        """Plain data, with the numbers of the table."""
        figures = {
            "median": self.median,
            "min": min(self.rates),
            "max": max(self.rates),
            "cpu_rate": self.cpu_rate,
        }
        return {**asdict(self), **figures}


class Contender:
    """Something that plays episodes and is timed."""

    def __init__(self, letter: str, name: str, processes: int, num_envs: int) -> None:
        self.row = Row(letter, name, processes, num_envs)
        self.episodes = 1

    def play(self, episodes: int) -> Turn:
        """Play whole episodes and time them."""
        raise NotImplementedError

    def warm_up(self, seconds: float) -> None:
        """Play one episode, and choose how many episodes take about ``seconds``."""
        self.play(1)
        self.episodes = max(1, round(seconds / self.play(1).seconds))

    def turn(self) -> None:
        """A measured turn."""
        self.row.turns.append(self.play(self.episodes))

    def close(self) -> None:
        """Close environments and processes."""


class Environments(Contender):
    """Batched or single environments that are reset and stepped from this process.

    Args:
        env: has ``reset`` and ``step``.
        dim: dimension of an action.
        pids: its worker processes.
        numpy: whether it takes numpy actions.
    """

    def __init__(
        self,
        letter: str,
        name: str,
        env: Any,
        num_envs: int,
        dim: int,
        pids: Sequence[int] = (),
        numpy: bool = False,
    ) -> None:
        super().__init__(letter, name, len(pids) or 1, num_envs)
        self.env, self.pids = env, list(pids)
        device = getattr(env, "device", torch.device("cpu"))
        self.cuda = torch.device(device).type == "cuda"
        generator = torch.Generator().manual_seed(0)
        actions = torch.rand(EPISODE, num_envs, dim, generator=generator) * 2 - 1
        self.actions: Any = actions.numpy() if numpy else actions.to(device)

    def _now(self) -> tuple[float, float]:
        if self.cuda:
            torch.cuda.synchronize()
        cpu = time.process_time() + sum(_cpu_seconds(pid) for pid in self.pids)
        return time.perf_counter(), cpu

    def play(self, episodes: int) -> Turn:
        wall, cpu = self._now()
        for _ in range(episodes):
            self.env.reset()
            for action in self.actions:
                self.env.step(action)
        end_wall, end_cpu = self._now()
        steps = episodes * EPISODE * self.row.num_envs
        return Turn(steps, end_wall - wall, end_cpu - cpu)

    def close(self) -> None:
        self.env.close()


class PhysicsAlone(Contender):
    """The substeps of an episode of ours, replayed in one or several processes.

    Args:
        helpers: the processes.
        env_cls: stock task class.
        num_envs: environments, summed over the processes.
    """

    def __init__(self, helpers: Sequence[Helper], env_cls: type[BaseEnv], num_envs: int) -> None:
        super().__init__("d", "physics alone", len(helpers), num_envs)
        self.helpers, self.env_cls = helpers, env_cls
        self.parts = [rows.stop - rows.start for rows in divide(num_envs, len(helpers))]

    def play(self, episodes: int) -> Turn:
        for helper, count in zip(self.helpers, self.parts, strict=True):
            helper.ask(_replay_episodes, self.env_cls, count, episodes)
        answers = [helper.answer() for helper in self.helpers]
        steps = episodes * EPISODE * self.row.num_envs
        # All start together; the slowest one counts.
        return Turn(steps, max(a[0] for a in answers), sum(a[1] for a in answers))


class Helper:
    """A process that calls functions, one after the other.

    Args:
        env_cls: stock task class that the process will use.
    """

    def __init__(self, env_cls: type[BaseEnv]) -> None:
        self.connection, theirs = Pipe()
        with theirs:
            self.process = start_process(_serve, theirs, preload=env_cls.__module__)

    def ask(self, function: Callable[..., Any], *args: Any) -> None:
        """Start a call of a top-level function."""
        self.connection.send((function, args))

    def answer(self) -> Any:
        """Wait for the result of the call.

        Raises:
            UserError: the process has ended.
        """
        try:
            return self.connection.recv()
        except EOFError as error:
            raise UserError("a process of the measurement ended: free some memory") from error

    def close(self) -> None:
        """End the process."""
        self.connection.close()
        self.process.join(10)


def _serve(connection: Connection) -> None:
    torch.set_num_threads(1)
    with suppress(EOFError, KeyboardInterrupt):
        while True:
            function, args = connection.recv()
            connection.send(function(*args))


class Replay:
    """An episode of ours, recorded so that only its substeps can be taken again.

    Args:
        env_cls: stock task class.
        num_envs: how many environments.
    """

    def __init__(self, env_cls: type[BaseEnv], num_envs: int) -> None:
        env = create(env_cls, num_envs, **_SETTINGS)
        env.reset(seed=0)
        self.env, px = env, env.scene.px
        self.systems = px.systems
        self.start = [system.pack() for system in self.systems]
        generator = torch.Generator().manual_seed(0)
        dim = env.single_action_space.shape[0]
        self.targets: list[list[list[float]]] = []
        for _ in range(EPISODE):
            env.step(torch.rand(num_envs, dim, generator=generator) * 2 - 1)
            self.targets.append(px.cuda_articulation_target_qpos.array.tolist())
        self.end = [system.pack() for system in self.systems]
        self.drives = [[j.set_drive_target for j in a.active_joints] for a in px._articulations]
        self.substeps = range(env._sim_steps_per_control)

    def play(self) -> tuple[float, float]:
        """Wall and processor seconds of the substeps of an episode, without anything else."""
        wall = cpu = 0.0
        for system, packed in zip(self.systems, self.start, strict=True):
            system.unpack(packed)
        steps, substeps = [system.step for system in self.systems], self.substeps
        for targets in self.targets:
            for drives, values in zip(self.drives, targets, strict=True):
                for drive, value in zip(drives, values, strict=False):
                    drive(value)
            begin, begin_cpu = time.perf_counter(), time.process_time()
            # Scene by scene, as in ours: a scene's data stay in the processor's cache.
            for step in steps:
                for _ in substeps:
                    step()
            wall += time.perf_counter() - begin
            cpu += time.process_time() - begin_cpu
        return wall, cpu


_REPLAYS: dict[tuple[type[BaseEnv], int], Replay] = {}


def _replay_episodes(env_cls: type[BaseEnv], num_envs: int, episodes: int) -> tuple[float, float]:
    """Wall and processor seconds of the substeps of some episodes, in this process."""
    key = env_cls, num_envs
    if key not in _REPLAYS:
        _REPLAYS[key] = Replay(*key)
    times = [_REPLAYS[key].play() for _ in range(episodes)]
    return sum(wall for wall, _ in times), sum(cpu for _, cpu in times)


def _stock(env_cls: type[BaseEnv]) -> gym.Env:
    """Stock ManiSkill on the CPU as in its documentation: one environment, NumPy."""
    prepare_headless()
    torch.set_num_threads(1)
    env = env_cls(num_envs=1, sim_backend="physx_cpu", render_backend="none", **_SETTINGS)
    return CPUGymWrapper(env)


def stock_class(task: str) -> type[BaseEnv]:
    """ManiSkill's own class of one of our tasks.

    Raises:
        UserError: there is no such task.
    """
    stock = {spec.cls for spec in REGISTERED_ENVS.values()}
    return next(cls for cls in task_class(task).__mro__ if cls in stock)


def _contenders(
    env_cls: type[BaseEnv], num_envs: Sequence[int], helpers: Sequence[Helper]
) -> list[Contender]:
    stock = _stock(env_cls)
    dim = stock.action_space.shape[0]  # type: ignore[index]
    alone = Environments("a", "stock", stock, 1, dim, numpy=True)
    alone.actions = alone.actions[:, 0]
    found: list[Contender] = [alone]
    numbers = sorted({1, len(helpers)})
    for processes in numbers:
        vector = gym.vector.AsyncVectorEnv([partial(_stock, env_cls)] * processes, context="spawn")
        pids = [process.pid for process in vector.processes if process.pid is not None]
        name = "stock in AsyncVectorEnv"
        found.append(Environments("b", name, vector, processes, dim, pids, numpy=True))
    for processes in numbers:
        for count in num_envs:
            if count >= processes:
                found.append(_ours(env_cls, count, workers=processes))
                found.append(PhysicsAlone(helpers[:processes], env_cls, count))
    if torch.cuda.is_available():
        # Without PhysX's GPU library there is no such contender.
        with suppress(UserError):
            found += [_ours(env_cls, count, sim="cuda") for count in num_envs]
    return found


def _ours(env_cls: type[BaseEnv], num_envs: int, **options: Any) -> Environments:
    """Our environments; ``options`` of `symsteer.bench.sim.create`."""
    env = create(env_cls, num_envs, **_SETTINGS, **options)
    letter, name = ("g", "ours on CUDA") if options.get("sim") == "cuda" else ("c", "ours")
    dim = env.single_action_space.shape[0]
    return Environments(letter, name, env, num_envs, dim, getattr(env, "worker_pids", []))


def measure(
    task: str = "PickCube-v1",
    num_envs: Sequence[int] = (1, 4, 16, 64, 256),
    repeats: int = 5,
    seconds: float = 0.7,
    cores: int | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Measure all contenders in turns, the parts of a step, and memory.

    Args:
        task: name of a task; ManiSkill's stock class and controller are measured.
        num_envs: numbers of environments of ours and of the physics alone.
        repeats: turns of each contender, at least 5 to show a spread.
        seconds: length of a turn, rounded to whole episodes of 50 steps.
        cores: processes of the contenders that use several; by default, one for each core.
        report: called with messages about the progress.

    Returns:
        Plain data: ``rows`` (one for each contender), ``summary`` (ratios), ``step`` (time of the
        parts of a step), ``creation``, ``machine``, ``settings``.

    Raises:
        UserError: an unknown task, or a number out of range.
    """
    env_cls = stock_class(task)
    if repeats < 1 or not 0 < seconds < math.inf or not num_envs or min(num_envs) < 1:
        raise UserError("repeats, seconds and every number of environments must be positive")
    if sum(set(num_envs)) > MAX_SCENES:
        raise UserError(
            f"one process holds at most {MAX_SCENES} environments, all of --num-envs together; "
            f"these are {sum(set(num_envs))}, so lower them"
        )
    there = len(os.sched_getaffinity(0))
    cores = cores or there
    if not 1 <= cores <= there:
        raise UserError(f"cores is {cores}; this machine has {there}: choose 1 to {there}")
    torch.set_num_threads(1)
    report("making environments")
    helpers = [Helper(env_cls) for _ in range(cores)]
    contenders = _contenders(env_cls, sorted(set(num_envs)), helpers)
    try:
        report("warming up")
        for contender in contenders:
            contender.warm_up(seconds)
        for repeat in range(repeats):
            report(f"repeat {repeat + 1} of {repeats}")
            for contender in contenders:
                contender.turn()
    finally:
        for helper in helpers:
            helper.close()
        for contender in contenders:
            contender.close()
    rows = [contender.row for contender in contenders]
    report("timing the parts of a step")
    size = min((n for n in num_envs if n >= 64), default=max(num_envs))
    return {
        "settings": {
            "task": task,
            "controller": CONTROLLER,
            "repeats": repeats,
            "seconds": seconds,
            "episode": EPISODE,
            "cores": cores,
        },
        "machine": _machine(),
        "rows": [row.to_json() for row in rows],
        "summary": summarise(rows, cores),
        "step": split_step(env_cls, size),
        "creation": creation(env_cls, max(num_envs)),
    }


def summarise(rows: Sequence[Row], cores: int) -> dict[str, dict[str, float]]:
    """Best rates of ours, stock and physics alone on one core and on all, and their ratios."""
    found = {}
    for processes in sorted({1, cores}):
        best = {
            letter: max(
                (row for row in rows if (row.letter, row.processes) == (letter, processes)),
                key=lambda row: row.median,
            )
            for letter in "bcd"
        }
        ours = best["c"]
        found[str(processes)] = {
            "ours": ours.median,
            "num_envs": ours.num_envs,
            "times_stock": ours.median / best["b"].median,
            "share_of_limit": ours.median / best["d"].median,
            "times_stock_cpu": ours.cpu_rate / best["b"].cpu_rate,
            "share_of_limit_cpu": ours.cpu_rate / best["d"].cpu_rate,
        }
    return found


# ---------------------------------------------------------------------------- inside a step


class _Stopwatch:
    """Seconds by part; a nested part does not count for the part around it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._parts: list[str] = []
        self._since = 0.0

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        self._charge()
        self._parts.append(name)
        try:
            yield
        finally:
            self._charge()
            self._parts.pop()

    def _charge(self) -> None:
        now = time.process_time()
        if self._parts:
            name = self._parts[-1]
            self.seconds[name] = self.seconds.get(name, 0.0) + now - self._since
        self._since = now

    def watch(self, owner: Any, method: str, part: str) -> None:
        """Time a method of an object as a part."""
        original = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.part(part):
                return original(*args, **kwargs)

        setattr(owner, method, timed)


def split_step(env_cls: type[BaseEnv], num_envs: int, episodes: int = 2) -> dict[str, float]:
    """Milliseconds of processor time of the parts of a step of ours.

    Returns:
        ``physics`` (substeps), ``fetch`` (reading the scenes, contacts included), ``apply``
        (writing drive targets), ``controller`` (action to drive targets), ``task`` (success,
        observation, reward), ``other``, ``total``, ``reset`` (of all environments, at once) and
        ``num_envs``.
    """
    player = _ours(env_cls, num_envs)
    player.play(1)
    env = player.env
    watch, px = _Stopwatch(), env.scene.px
    watch.watch(px, "finish_substeps", "physics")
    # type(px), since px.__class__ is SAPIEN's PhysxGpuSystem.
    for name in dir(type(px)):
        if name.startswith(("gpu_fetch", "fetch_", "gpu_query")):
            watch.watch(px, name, "fetch")
        elif name.startswith(("gpu_apply", "apply_")):
            watch.watch(px, name, "apply")
    watch.watch(env.agent, "set_action", "controller")
    for name in ("get_info", "get_obs", "get_reward"):
        watch.watch(env, name, "task")
    reset = 0.0
    for _ in range(episodes):
        before, begin = dict(watch.seconds), time.process_time()
        env.reset()
        reset += time.process_time() - begin
        watch.seconds = before
        for action in player.actions:
            with watch.part("other"):
                env.step(action)
    env.close()
    steps = episodes * EPISODE
    parts = ("physics", "fetch", "apply", "controller", "task", "other")
    split = {part: 1e3 * watch.seconds.get(part, 0.0) / steps for part in parts}
    return {
        **split,
        "total": sum(split.values()),
        "reset": 1e3 * reset / episodes,
        "num_envs": num_envs,
    }


# ---------------------------------------------------------------------------- memory


def creation(env_cls: type[BaseEnv], num_envs: int) -> dict[str, float]:
    """Time and memory that environments take, measured in a fresh process.

    Returns:
        ``first_ms`` (of the first environment, which loads files), ``per_env_ms``,
        ``per_env_kib`` (from the difference of ``num_envs`` and one), ``process_mib`` (resident
        before any environment), ``num_envs``.
    """
    helper = Helper(env_cls)
    try:
        helper.ask(_creation, env_cls, num_envs)
        return helper.answer()
    finally:
        helper.close()


def _creation(env_cls: type[BaseEnv], num_envs: int) -> dict[str, float]:
    seconds, sizes = [], [_resident()]
    kept = []
    for count in (1, num_envs):
        begin = time.process_time()
        env = create(env_cls, count, **_SETTINGS)
        seconds.append(time.process_time() - begin)
        env.step(torch.zeros(count, env.single_action_space.shape[0]))
        kept.append(env)
        gc.collect()
        sizes.append(_resident())
    return {
        "num_envs": num_envs,
        "first_ms": 1e3 * seconds[0],
        "per_env_ms": 1e3 * seconds[1] / num_envs,
        "per_env_kib": (sizes[2] - sizes[1]) / num_envs / 2**10,
        "process_mib": sizes[0] / 2**20,
    }


def memory_growth(
    task: str = "PickCube-v1",
    num_envs: int = 4,
    steps: int = 10_000,
    report: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Resident memory of this process while environments are stepped and reset.

    Returns:
        ``steps`` and ``mib`` of ten samples, and ``growth_kib``, from the second to the last.
    """
    player = _ours(stock_class(task), num_envs)
    samples: dict[int, float] = {}
    every = max(1, steps // EPISODE // 10)
    for episode in range(1, steps // EPISODE + 1):
        player.play(1)
        if episode % every == 0:
            gc.collect()
            samples[episode * EPISODE] = _resident() / 2**20
            report(f"{episode * EPISODE:6d} steps: {samples[episode * EPISODE]:.1f} MiB")
    player.close()
    mib = list(samples.values())
    growth = 2**10 * (mib[-1] - mib[min(1, len(mib) - 1)])
    return {
        "num_envs": num_envs,
        "steps": list(samples),
        "mib": mib,
        "growth_kib": growth,
    }


def _resident() -> int:
    """Resident bytes of this process."""
    return psutil.Process().memory_info().rss


def _cpu_seconds(pid: int) -> float:
    """User and system time of a process."""
    times = psutil.Process(pid).cpu_times()
    return times.user + times.system


def _machine() -> dict[str, Any]:
    return {
        "cpu": processor_name() or platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
        "cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        **{package: version(package) for package in ("mani-skill", "sapien", "torch", "gymnasium")},
    }


# ---------------------------------------------------------------------------- table


def table(data: dict[str, Any]) -> str:
    """Text table of the result of `measure`."""
    settings, rows = data["settings"], data["rows"]
    lines = [
        f"{settings['task']} with ManiSkill's own class and controller {settings['controller']}; "
        f"{data['machine']['cpu']}",
        f"median of {settings['repeats']} turns (smallest to largest), all contenders in turns; "
        f"episodes of {settings['episode']} random steps, resets included",
        "",
        "                            processes   envs   steps/s               steps/CPU second",
    ]
    for row in rows:
        spread = f"({row['min']:,.0f} to {row['max']:,.0f})"
        lines.append(
            f"{row['letter']}  {row['name']:25s} {row['processes']:8d} {row['num_envs']:6d} "
            f"{row['median']:9,.0f} {spread:20s} {row['cpu_rate'] / row['processes']:9,.0f}"
        )
    lines.append("")
    for processes, found in data["summary"].items():
        cores = "one core" if processes == "1" else f"{processes} cores"
        lines.append(
            f"ours on {cores}: {found['ours']:,.0f} steps/s with {found['num_envs']} environments, "
            f"{found['times_stock']:.1f} x stock (b), {found['share_of_limit']:.0%} of the physics "
            f"alone (d); by CPU time {found['times_stock_cpu']:.1f} x and "
            f"{found['share_of_limit_cpu']:.0%}"
        )
    lines.append(f"goal: {MIN_STOCK_RATIO:g} x and {MIN_LIMIT_SHARE:.0%}")
    step, made = data["step"], data["creation"]
    parts = ", ".join(
        f"{part} {step[part]:.2f} ({step[part] / step['total']:.0%})"
        for part in ("physics", "fetch", "apply", "controller", "task", "other")
    )
    lines += [
        "",
        f"CPU time of a step of {step['num_envs']} environments: {step['total']:.2f} ms = {parts};",
        f"of a reset of all: {step['reset']:.1f} ms",
        f"to make an environment: {made['per_env_ms']:.1f} ms, {made['per_env_kib']:.0f} KiB "
        f"(the first one {made['first_ms']:.0f} ms; a process without environments has "
        f"{made['process_mib']:.0f} MiB resident, mostly shared libraries)",
    ]
    return "\n".join(lines)


def dump(data: dict[str, Any]) -> str:
    """JSON of the result of `measure` or `memory_growth`."""
    return json.dumps(data, indent=2, allow_nan=False)
