"""The verbs of ``symsteer``.

Verbs import what they need when they are called, so that ``--help`` and ``doctor`` work on a
machine where the simulator does not.
"""

from __future__ import annotations

import errno
import importlib
import inspect
import os
import re
import shutil
import signal
import sys
import textwrap
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from symsteer.bench.runs.config import DemonstrationConfig, RunConfig
from symsteer.bench.sim.errors import WorkerLostError
from symsteer.errors import UserError
from symsteer.leaderboard.errors import RecordError
from symsteer.policies.base import PolicyName

ABOUT = "How much symmetry should an RL agent keep when it steers an equivariant diffusion policy?"

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

LONGEST_COMPLAINT = 900
"""Characters of an error message; the middle of a longer one is left out."""

app = tyro.extras.SubcommandApp()


@app.command
def run(
    config: Annotated[RunConfig, tyro.conf.arg(name="")],
    out: Path = Path("runs"),
    demos: Path | None = None,
    base_policy: Path | None = None,
    workers: int = 1,
    quiet: bool = False,
) -> int:
    """Steer a base policy with one agent on one task, and record what happens.

    Args:
        config: What to run.
        out: Folder of the runs; demonstrations and base policies are kept in OUT/base.
        demos: Trajectory file (.h5 with .json) to train the base policy on, instead of the
            scripted expert's demonstrations.
        base_policy: Saved base policy (policy.safetensors) to steer, instead of training one; it
            brings its settings and the demonstrations that it knows of.
        workers: Processes that share the simulation; the record is the same but for the clock.
        quiet: No progress bars.
    """
    from symsteer.bench.runs.run import execute

    _tell(execute(config, out, demos, base_policy, progress=not quiet, workers=workers))
    return 0


@app.command
def resume(folder: Path, /, workers: int = 1, quiet: bool = False) -> int:
    """Continue a run that was stopped, from its last checkpoint; the record comes out the same.

    Args:
        folder: The run's folder (it holds config.json).
        workers: Processes that share the simulation; the record is the same but for the clock.
        quiet: No progress bars.
    """
    from symsteer.bench.runs.run import resume

    _tell(resume(folder, progress=not quiet, workers=workers))
    return 0


@app.command
def evaluate(
    folder: Path,
    /,
    variant: str | None = None,
    episodes: int | None = None,
    workers: int = 1,
    json: bool = False,
) -> int:
    """Play held-out episodes with the last checkpoint of a run, in its world or in another one.

    With the run's own variant and number of episodes this says whether they come out as recorded.

    Args:
        folder: The run's folder; nothing in it changes.
        variant: How the world is broken, such as action_gain:0.5, or none; default: as in the run.
        episodes: Number of held-out episodes; default: as many as the record's final ones.
        workers: Processes that share the simulation.
        json: Print every episode and diagnostic as JSON, and nothing else.
    """
    from json import dumps

    from scipy.stats import binomtest

    from symsteer.bench.runs.run import evaluate

    found = evaluate(folder, variant, episodes, workers)
    if json:
        print(dumps(found.to_json()))
        return 0
    columns = found.evaluation.episodes
    count, successes = len(columns.seed), sum(columns.success_once)
    sure = binomtest(successes, count).proportion_ci(method="wilson")
    print(f"run           {found.run_id}, checkpoint at {found.evaluation.env_steps} steps")
    print(f"variant       {found.variant}")
    print(
        f"success_once  {successes / count:.2f} [{sure.low:.2f}, {sure.high:.2f}] "
        f"({successes} of {count} held-out episodes; 95 % Wilson interval)"
    )
    print(f"at the end    {sum(columns.success_at_end) / count:.2f}")
    print(f"mean length   {sum(columns.episode_len) / count:.1f} steps")
    if found.recorded is not None:
        same = "the same episodes as in" if found.recorded else "NOT the episodes of"
        print(f"record        {same} the final evaluation")
    return 0 if found.recorded is not False else 1


def _tell(folder: Path) -> None:
    """Where the results of a finished run are."""
    out = folder.parent
    print(f"record:      {folder / 'record.json'}")
    print(f"TensorBoard: tensorboard --logdir {out}")
    print(f"symsteer.leaderboard: symsteer report {out} --out {out / 'leaderboard'}")


@app.command
def sweep(
    suite: Annotated[str, tyro.conf.arg(metavar="SUITE")],
    /,
    out: Path = Path("runs"),
    workers: int = 0,
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None,
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False,
) -> int:
    """Work off a suite of runs; the same command goes on where it stopped.

    Finished runs are skipped, unfinished ones continue, failed ones are tried once more and listed
    at the end.

    Args:
        suite: Name of a suite (see `symsteer list`) or path of a .toml file.
        out: Folder of the runs; a sweep on a cluster needs one that all its machines share.
        workers: Runs side by side; 0 means one a core, or as many as the cluster has room for.
        ray: Address of a Ray cluster to run on: auto, or host:port of its head.
        dry_run: Say what there is to do and how long it may take, and do nothing.
    """
    from symsteer.bench.sweep.command import preview, run_plan
    from symsteer.bench.sweep.plan import make_plan, manifest_path
    from symsteer.bench.sweep.suite import load_suite

    plan = make_plan(load_suite(suite), out, elsewhere=ray is not None)
    if dry_run:
        print(preview(plan, workers, ray))
        return 0
    outcomes = run_plan(plan, workers, ray)
    failed = [outcome for outcome in outcomes if outcome.status == "failed"]
    for outcome in failed:
        print(f"failed: {outcome.cell.label}: {outcome.reason}", file=sys.stderr)
    if any(outcome.trace for outcome in failed):
        log = manifest_path(out, plan.name).with_suffix(".log")
        print(f"where it went wrong in the code: {log}", file=sys.stderr)
    elsewhere = sum(outcome.status == "elsewhere" for outcome in outcomes)
    if elsewhere:
        print(
            f"{elsewhere} runs are worked on by another process; `symsteer status {out}` says "
            "when they are finished",
            file=sys.stderr,
        )
    return 1 if failed or elsewhere else 0


@app.command
def status(
    folder: Annotated[Path, tyro.conf.arg(metavar="[FOLDER]")] = Path("runs"),
    /,
    suite: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
) -> int:
    """Say how far the sweeps in a folder are: runs by state, failures, time left.

    Args:
        folder: Folder of the runs, the --out of a sweep.
        suite: Only the sweep of this suite.
    """
    from symsteer.bench.sweep.status import read_status, to_text

    overview = read_status(folder, suite)
    if overview.found or not overview.damage:
        print(_printable(to_text(overview.found, folder)))
    for error in overview.damage:
        _complain(error, f"error: {error}", 2)
    return 2 if overview.damage else 0


@app.command
def demo(out: Path = Path("runs/demo")) -> int:
    """The whole path in minutes on a CPU: demonstrations, base policy, five agents, leaderboard.

    Args:
        out: Folder of the runs and of their leaderboard.
    """
    exit_code = sweep("demo", out=out)
    report((out,), out=out / "leaderboard")
    page = out / "leaderboard" / "LEADERBOARD.md"
    print(
        f"\nOpen the leaderboard:  {page}"
        f"\nSee the runs:          {_program('tensorboard')} --logdir {out}"
        "  then http://localhost:6006"
    )
    return exit_code


@app.command
def report(
    records: tyro.conf.Positional[tuple[Path, ...]] = (),
    out: Path | None = None,
    audit: Path | None = None,
    verify: bool = False,
    check: bool = False,
) -> int:
    """Write the leaderboard (markdown, CSV, figures) from run records; `python -m leaderboard`.

    Args:
        records: Record files, run folders or folders of runs; default: the committed records.
        out: Where to write; default: the leaderboard folder of this repository.
        audit: The summary.json of an audit, for the map; default: the committed one.
        verify: Write nothing; fail if OUT is not, byte for byte, what the records give.
        check: Write nothing; say of each record whether the leaderboard admits it, and why not.
    """
    options = {"--out": out, "--audit": audit}
    arguments = [text for name, value in options.items() if value for text in (name, str(value))]
    arguments += ["--verify"] * verify + ["--check"] * check + ["--", *map(str, records)]
    # By name, not by import: the bench writes records and draws nothing.
    return importlib.import_module("symsteer.leaderboard.__main__").main(arguments)


@app.command(name="list")
def list_names() -> int:
    """Name the tasks, embodiments, variants, agents and suites."""
    from symsteer.agents import AGENTS
    from symsteer.bench.sweep.suite import load_suite, suite_names
    from symsteer.bench.tasks import task_class, task_names
    from symsteer.bench.tasks.embodiments import EMBODIMENTS
    from symsteer.bench.variants import registry

    tasks = {name: sys.modules[task_class(name).__module__] for name in task_names()}
    suites = [load_suite(name) for name in suite_names()]
    _print_names("tasks (--task)", {name: _summary(task) for name, task in tasks.items()})
    _print_names(
        "embodiments (--embodiment)", {name: _summary(e) for name, e in EMBODIMENTS.items()}
    )
    _print_names(
        "variants (--variant NAME:STRENGTH, strength in [0, 1]; several joined by +; or none)",
        {name: _summary(variant) for name, variant in registry().items()},
    )
    _print_names("agents (--agent)", {name: _summary(agent) for name, agent in AGENTS.items()})
    _print_names(
        "suites (symsteer sweep SUITE)",
        {suite.name: f"{suite.description} ({len(suite.runs)} runs)" for suite in suites},
    )
    return 0


@app.command
def demos(
    path: Path,
    /,
    task: str = "PickCube-v1",
    embodiment: str = "floating",
    count: int = 50,
    mode: Literal["clean", "diverse"] = "diverse",
    seed: int = 0,
) -> int:
    """Write demonstrations of the scripted expert as a ManiSkill trajectory (.h5 and .json).

    Args:
        path: The .h5 file to write.
        task: Task; `symsteer list` names them.
        embodiment: floating or panda.
        count: Number of demonstrations, successes all.
        mode: clean, or diverse (correlated noise and offsets: what steering needs).
        seed: Seed of the collection.
    """
    from tqdm import tqdm

    from symsteer.bench.demos import collect, load

    with tqdm(total=count, desc="demonstrations", disable=None) as bar:

        def advance(done: int, total: int) -> None:
            bar.update(done - bar.n)

        collect(task, embodiment, count, mode, seed, path, progress=advance)
    steps = load(path, task, embodiment).meta["steps"]
    print(f"wrote {count} demonstrations, {steps} steps, to {path}")
    return 0


@app.command
def base(
    task: str = "PickCube-v1",
    embodiment: str = "floating",
    mode: Literal["clean", "diverse"] = "diverse",
    policies: tuple[PolicyName, ...] = ("edp", "plain", "plain-augmented"),
    demonstrations: tuple[int, ...] = (5, 10, 20, 50),
    seeds: int = 3,
    episodes: int = 200,
    workers: int = 0,
    out: Path = Path("runs"),
) -> int:
    """Train base policies from few demonstrations and compare their success.

    Args:
        task: Task; `symsteer list` names them.
        embodiment: floating or panda.
        mode: Kind of demonstrations.
        policies: Which policies.
        demonstrations: Numbers of demonstrations.
        seeds: Seeds a cell; each has its own demonstrations.
        episodes: Held-out episodes a policy.
        workers: Policies side by side; 0 means one a core.
        out: Folder for demonstrations and the table's data.
    """
    from symsteer.bench.runs.base_study import study, table, write_study
    from symsteer.bench.runs.run import check

    config = RunConfig(
        task=task, embodiment=embodiment, demonstrations=DemonstrationConfig(mode=mode)
    )
    check(config)
    workers = workers or os.cpu_count() or 1
    rows = study(config, out, policies, demonstrations, seeds, episodes, workers)
    path = out / "base" / f"study-{task}-{embodiment}-{mode}.json"
    write_study(path, config, rows)
    print(table(rows))
    print(f"wrote {path}")
    return 0


@app.command
def audit(
    task: tuple[str, ...] = ("PickCube-v1",),
    embodiment: tuple[str, ...] = ("floating",),
    variant: tuple[str, ...] = ("none",),
    strength: tuple[float, ...] = (),
    group: str = "C8",
    states: Literal["both", "expert", "policy"] = "both",
    count: int = 32,
    chunk: int = 4,
    resets: int = 256,
    seed: int = 0,
    sim: Literal["cpu", "cuda"] = "cpu",
    base_policy: Path | None = None,
    runs: Path = Path("runs"),
    out: Path | None = None,
    resume: bool = False,
    json: bool = False,
    rollouts: int = 0,
    actions: Literal["expert", "random", "policy"] = "expert",
) -> int:
    """Measure how broken the symmetry of a task is, in simulation (docs/audit.md).

    Several tasks, embodiments, variants and strengths give a table with a row for each.

    Args:
        task: Tasks, or all; `symsteer list` names them.
        embodiment: floating, panda, or all.
        variant: none, names, name:strength, several of these joined with +, or all.
        strength: Strengths of the variants that are named without one.
        group: Symmetry group, e.g. C8, D4 (with reflections).
        states: Who visits the states: the scripted expert, random noise through the base policy.
        count: States of each visitor, each from an episode of its own.
        chunk: Control steps of an action chunk.
        resets: Initial states that are compared with as many turned ones.
        seed: Seed of states, draws and intervals.
        sim: Where physics runs.
        base_policy: Saved base policy, instead of the one that `run` would train.
        runs: Folder of the runs; demonstrations and base policies are kept in RUNS/base.
        out: Folder for audit.json, map.csv and map.png; several audits get a folder each and
            table.csv, table.md and summary.json beside them.
        resume: Read audits with the same settings from OUT instead of measuring them again.
        json: Print JSON and nothing else.
        rollouts: If above 0: compare this many whole episodes of the floating gripper with their
            turned copies instead.
        actions: Who acts in these episodes.
    """
    from json import dumps

    from symsteer.bench.audit.report import summary, text, to_markdown, write_table
    from symsteer.bench.audit.result import AuditSettings
    from symsteer.bench.audit.study import compare_rollouts, grid, run_audits

    template = AuditSettings(
        group=group, states=states, count=count, chunk=chunk, resets=resets, seed=seed, sim=sim
    )
    wanted = grid(task, embodiment, variant, strength, template)
    several = len(wanted) > 1
    if rollouts:
        for settings in wanted:
            error = compare_rollouts(settings, rollouts, actions, runs, base_policy, not json)
            print(f"{settings.name}, {actions}")
            print(error.summary())
        return 0

    def done(result: Any) -> None:
        if several:
            print(f"{result.settings.name}: {result.seconds:.1f} s", file=sys.stderr, flush=True)

    found = run_audits(wanted, runs, base_policy, out, resume, progress=not json, done=done)
    if several and out is not None:
        write_table(found, out)
    if json:
        plain = [result.to_json() for result in found]
        print(dumps(plain if several else plain[0]))
    elif several:
        print(to_markdown([summary(result) for result in found]), end="")
    else:
        print(text(found[0]))
    if out is not None and not json:
        print(f"wrote {out}")
    return 0


@app.command
def throughput(
    task: str = "PickCube-v1",
    num_envs: tuple[int, ...] = (1, 4, 16, 64, 256),
    repeats: int = 5,
    seconds: float = 0.7,
    cores: int = 0,
    memory: bool = False,
    json: bool = False,
) -> int:
    """Measure simulation against stock ManiSkill and against the physics alone; minutes.

    Args:
        task: Task; `symsteer list` names them. ManiSkill's stock class and controller are used.
        num_envs: Numbers of environments.
        repeats: Turns of each contender.
        seconds: Least length of a turn.
        cores: Processes where all cores are used; 0 means all.
        memory: Only watch the memory over 10,000 steps with resets.
        json: Machine-readable output.
    """
    from symsteer.bench import throughput as speed

    def report(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    if memory:
        growth = speed.memory_growth(task, report=report)
        print(
            speed.dump(growth)
            if json
            else f"memory grew by {growth['growth_kib']:.0f} KiB from step {growth['steps'][1]} to "
            f"{growth['steps'][-1]} of {growth['num_envs']} environments"
        )
        return 0
    data = speed.measure(task, num_envs, repeats, seconds, cores or None, report)
    print(speed.dump(data) if json else speed.table(data))
    return 0


@app.command
def doctor(quiet: bool = False) -> int:
    """Say what this machine can do, and what to install for more.

    Args:
        quiet: Only what is missing and needed.
    """
    from symsteer.bench.sim.capabilities import probe

    checks = probe()
    for check in checks:
        if check.ok and quiet:
            continue
        if not check.ok and quiet and not check.required:
            continue
        mark = "ok     " if check.ok else "MISSING" if check.required else "absent "
        print(f"{mark} {check.name:18s} {check.detail}")
        if not check.ok and check.cure:
            print(f"{'':26s} -> {check.cure}")
    return 0 if all(check.ok or not check.required for check in checks) else 1


def _summary(documented: object) -> str:
    """First line of a docstring."""
    return (inspect.getdoc(documented) or "").partition("\n")[0].replace("``", "")


def _print_names(title: str, names: dict[str, str]) -> None:
    """A paragraph of names with what they are, folded to the terminal."""
    print(title)
    columns = max(60, shutil.get_terminal_size().columns)
    for name, text in names.items():
        head = f"  {name:18s} "
        print(textwrap.fill(text, columns, initial_indent=head, subsequent_indent=" " * len(head)))
    print()


def _program(name: str) -> str:
    """How to call a console script of this environment from the present folder."""
    path = Path(sys.executable).with_name(name)
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return name


def main() -> int:
    """Parse the command line and run a verb.

    Returns:
        The exit code: 0 done, 1 something failed, 2 the input is wrong, 130 interrupted.
    """
    # Notes of third-party packages about optional parts that SymSteer does not use.
    warnings.filterwarnings("ignore", message=".*py3nj.*")
    warnings.filterwarnings("ignore", message="Failed to find system libvulkan.*")
    # The networks are small: more threads cost more than they give, above all beside other runs.
    torch.set_num_threads(_threads(os.environ.get("OMP_NUM_THREADS", "")))
    try:
        return app.cli(prog="symsteer", description=ABOUT, sort_subcommands=False)
    except (UserError, RecordError) as error:
        return _complain(error, f"error: {error}", 2)
    except WorkerLostError as error:
        return _complain(error, f"error: {error}", 1)
    except BrokenPipeError:
        # Whoever read the output has seen enough; Python would complain once more at its exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except OSError as error:
        # A path that cannot be read or written; without one it is a fault of ours.
        if error.filename is None:
            raise
        cure = "free space" if error.errno in FULL else "choose another path"
        return _complain(error, f"error: {error.filename}: {error.strerror}; {cure}", 2)
    except (MemoryError, RuntimeError) as error:
        # On the CPU torch raises a plain RuntimeError.
        full = isinstance(error, MemoryError | torch.OutOfMemoryError)
        if not full and "allocate memory" not in str(error):
            raise
        return _complain(
            error,
            "error: the memory of this machine does not suffice for what was asked; lower the "
            "numbers of environments and episodes, the replay capacity or the networks' width",
            2,
        )
    except KeyboardInterrupt as error:
        return _complain(error, "interrupted", 130)


def _threads(wanted: str) -> int:
    """The first number of OMP_NUM_THREADS (which may list one for each level), 1 without one."""
    number = re.match(r"\s*0*([1-9]\d{0,3})\b", wanted)
    return int(number[1]) if number else 1


def _printable(text: str) -> str:
    """Text without control characters, which a file may have brought into it."""
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in text)


def _complain(error: BaseException, text: str, code: int) -> int:
    """One sentence on stderr, and how to go on where that is known; returns the exit code."""
    # It may quote what the input held: line breaks, control characters, pages of text.
    line = _printable(" ".join(text.split()))
    if len(line) > LONGEST_COMPLAINT:
        half = LONGEST_COMPLAINT // 2
        line = f"{line[:half]} ... {line[-half:]}"
    print(line, *getattr(error, "__notes__", ()), sep="\n", file=sys.stderr)
    return code
