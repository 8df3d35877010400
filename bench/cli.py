"""The verbs that work with the simulator; ``symsteer.cli`` calls them.

Each function is one verb: its signature and docstring are its options and help. Heavy modules are
imported inside the functions, so that help, ``list`` and ``doctor`` do not wait for them.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from symsteer.bench.sweep.workforce import THIS_MACHINE, Workforce
from symsteer.errors import UserError
from symsteer.extras import extra
from symsteer.files import prepare_folder
from symsteer.registry import allow
from symsteer.terminal import BOARD, complain, folded, printable, to_paste

if TYPE_CHECKING:
    from symsteer.registry import Registry

Trust = Annotated[
    tuple[str, ...],
    tyro.conf.arg(help="Code of other authors that files name, as module:Class. It is executed."),
]
"""The option with which a user consents to code that files name."""

Track = tyro.conf.FlagCreatePairsOff[bool]

RunFolder = Annotated[Path, tyro.conf.arg(metavar="RUN")]


def run(arguments: list[str]) -> int:
    """Steer a base policy with one agent on one task.

    Its options depend on the agent and the policy that they name.
    """
    from symsteer.bench.runs.arguments import parse_run
    from symsteer.bench.runs.run import execute
    from symsteer.bench.runs.tracking import check_tracking

    config, how = parse_run(arguments)
    check_tracking(how.track)
    _print_places(execute(config, how))
    return 0


def resume(
    folder: RunFolder,
    /,
    sim_workers: int = 1,
    track: Track = False,
    quiet: bool = False,
    trust: Trust = (),
) -> int:
    """Continue a run that was stopped, from its last checkpoint.

    On the CPU the record is that of a run that was never stopped, except for times.

    Args:
        folder: The run's folder (it holds config.json).
        sim_workers: Processes that share the simulation; only times in the record change.
        track: Show the run in Weights & Biases, too; it continues there as well.
        quiet: No progress bars.
    """
    allow(*trust)
    from symsteer.bench.runs.config import Execution
    from symsteer.bench.runs.run import execute
    from symsteer.bench.runs.tracking import check_tracking

    check_tracking(track)
    _print_places(execute(folder, Execution(sim_workers=sim_workers, track=track, quiet=quiet)))
    return 0


def reproduce(
    record: Annotated[Path, tyro.conf.arg(metavar="RECORD")],
    /,
    out: Path | None = None,
    demos: Path | None = None,
    base_policy: Path | None = None,
    base_from: Path | None = None,
    into: Path | None = None,
    sim_workers: int = 1,
    trust: Trust = (),
) -> int:
    """Make a run again from its record, and say what agrees (docs/runner.md).

    Demonstrations and base policy are made anew, too, unless --base-from is given. Exit code 0 if
    every episode and number agrees exactly, 1 if not.

    Args:
        record: A record.json, the folder of a run, or a folder of submitted records: then one of
            them, drawn at random.
        out: Folder for the new run and reproduction.json; default: a temporary folder, which is
            kept. The same command continues a reproduction that was stopped there.
        demos: The trajectory file that the run began from, if it did.
        base_policy: The saved base policy that the run began from, if it did.
        base_from: Folder of runs whose demonstrations and base policy (in its folder base) are
            taken, because a policy that is trained on another kind of processor differs.
        into: Folder that gets, named after the record's hash, what the leaderboard reads: a copy of
            reproduction.json, the new record, and the line for the list of the study.
        sim_workers: Processes that share the simulation.
    """
    allow(*trust)
    from symsteer.bench.runs.config import Execution
    from symsteer.bench.runs.reproduce import reproduce, text

    how = Execution(demos=demos, base_policy=base_policy, sim_workers=sim_workers)
    done = reproduce(record, out, how, into, base_from, _tell)
    print(printable(text(done)))
    return 0 if done.reproduction.verdict == "exact" else 1


def evaluate(
    folder: RunFolder,
    /,
    variant: str | None = None,
    episodes: int | None = None,
    sim_workers: int = 1,
    json: bool = False,
    trust: Trust = (),
) -> int:
    """Play held-out episodes with the last checkpoint of a run, in its own variant or another.

    With the run's own variant and number of episodes, it compares them with the record.

    Args:
        folder: The run's folder; nothing in it changes.
        variant: How the symmetry is broken, e.g. action_gain:0.5, or none; default: as in the run.
        episodes: Number of held-out episodes; default: as many as the record's final ones.
        sim_workers: Processes that share the simulation.
        json: Print only JSON, with every episode and diagnostic.
    """
    allow(variant, *trust)
    from json import dumps

    from scipy.stats import binomtest

    from symsteer.bench.runs.run import evaluate

    result = evaluate(folder, variant, episodes, sim_workers)
    if json:
        print(dumps(result.to_json()))
        return 0
    played = result.evaluation.episodes
    count, successes = len(played.seed), sum(played.success_once)
    sure = binomtest(successes, count).proportion_ci(method="wilson")
    print(f"run           {result.run_id}, checkpoint at {result.evaluation.env_steps} steps")
    print(f"variant       {result.variant}")
    print(
        f"success_once  {successes / count:.2f} [{sure.low:.2f}, {sure.high:.2f}] "
        f"({successes} of {count} held-out episodes; 95 % Wilson interval)"
    )
    print(f"at the end    {sum(played.success_at_end) / count:.2f}")
    print(f"mean length   {sum(played.episode_len) / count:.1f} steps")
    if result.recorded is not None:
        same = "the same episodes as in" if result.recorded else "NOT the episodes of"
        print(f"record        {same} the final evaluation")
    return 0 if result.recorded is not False else 1


def film(
    folders: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="RUN [RUN ...]")],
    /,
    variant: str | None = None,
    episodes: int = 3,
    out: Path | None = None,
    trust: Trust = (),
) -> int:
    """Film held-out episodes with the last checkpoints of runs.

    Several runs play the same episodes side by side. Where no Vulkan driver works, a picture of the
    paths seen from above is written instead.

    Args:
        folders: The runs' folders.
        variant: How the symmetry is broken, e.g. action_gain:0.5, or none; default: as in the run.
        episodes: Number of held-out episodes.
        out: The film, .mp4 or .gif; default: an .mp4 in the run's folder, for several runs beside
            the first one.
    """
    allow(variant, *trust)
    from symsteer.bench.runs.film import film
    from symsteer.bench.sim.headless import RENDERING_CURE, rendering_works

    path = film(folders, variant, episodes, out)
    if not rendering_works():
        print(f"no video: no Vulkan driver was found; {RENDERING_CURE}", file=sys.stderr)
    print(f"wrote {path}")
    return 0


def sweep(
    suite: Annotated[str, tyro.conf.arg(metavar="SUITE")],
    /,
    runs: Path = Path("runs"),
    workforce: Annotated[Workforce, tyro.conf.arg(name="")] = THIS_MACHINE,
    launcher: Annotated[str | None, tyro.conf.arg(metavar="slurm|FILE")] = None,
    shard: Annotated[str | None, tyro.conf.arg(metavar="I/N")] = None,
    track: Track = False,
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False,
    trust: Trust = (),
) -> int:
    """Run all runs of a suite; the same command continues a sweep that was stopped.

    Finished runs are skipped, unfinished runs continue. A run that fails is tried once more, and
    listed at the end if it fails again.

    Args:
        suite: Name of a suite (see `symsteer list`) or path of a .toml file.
        runs: Folder of the runs; a sweep on a cluster needs one that all its machines share.
        launcher: Queue the runs as one array of Slurm, and return: slurm, or a .toml file with
            partition, time, memory and set-up of its tasks (docs/clusters.md).
        shard: Only a share of the runs: 3/16 is the third of 16, for any other scheduler.
        track: Show the runs in Weights & Biases, too, in a group with the name of the suite.
        dry_run: Only show which runs are left and how long they may take.
    """
    allow(*trust)
    from dataclasses import replace

    from symsteer.bench.runs.tracking import check_tracking
    from symsteer.bench.sweep.command import preview, run_plan, settled
    from symsteer.bench.sweep.plan import make_plan, share_of
    from symsteer.bench.sweep.suite import load_suite
    from symsteer.bench.throughput import measure

    plan = make_plan(load_suite(suite), runs, bool(workforce.ray or launcher))
    if shard is not None:
        plan = share_of(plan, shard)
    if launcher is not None:
        from symsteer.bench.sweep.slurm import launch

        check_tracking(track)
        more = (*("--track",) * track, *(("--trust", *trust) if trust else ()))
        print(printable(launch(plan, suite, launcher, workforce, more, dry_run)))
        return 0
    if workforce.workers == "auto" and workforce.ray is None:
        workforce = settled(plan, workforce, None if dry_run else measure, _tell)
    if dry_run:
        print(preview(plan, workforce))
        return 0
    check_tracking(track)
    ends = run_plan(replace(plan, track=track), workforce)
    failed = [end for end in ends if end.status == "failed"]
    for end in failed:
        print(f"failed: {end.run.label}: {end.reason}", file=sys.stderr)
    if any(end.trace for end in failed):
        print(f"tracebacks: {plan.path.with_suffix('.log')}", file=sys.stderr)
    elsewhere = sum(end.status == "elsewhere" for end in ends)
    if elsewhere:
        print(
            f"another process works on {elsewhere} of the runs; this shows when they are finished: "
            f"{to_paste('symsteer', 'status', runs)}",
            file=sys.stderr,
        )
    return 1 if failed or elsewhere else 0


def tune(
    plan: Annotated[str, tyro.conf.arg(metavar="PLAN")],
    /,
    runs: Path = Path("runs"),
    workforce: Annotated[Workforce, tyro.conf.arg(name="")] = THIS_MACHINE,
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False,
    trust: Trust = (),
) -> int:
    """Search for the best settings of agents, with the same number of trials for each.

    The same command continues a search that was stopped, with the same trials.

    Args:
        plan: Name of a tuning plan (see `symsteer list`) or path of a .toml file.
        runs: Folder of the runs; trials and chosen settings are written to RUNS/tuning.
        dry_run: Only show what would be tried.
    """
    allow(*trust)
    with extra("tune", "symsteer tune"):
        from symsteer.bench.tuning.command import Tuner, preview
    from symsteer.bench.tuning.plan import read_plan

    found = read_plan(plan)
    if dry_run:
        print(preview(found))
        return 0
    from symsteer.bench.tuning.trials import to_text

    tuner = Tuner(found, runs, workforce)
    trials, chosen = tuner.play()
    print(f"\n{to_text(trials, chosen)}\n")
    for kind, path in tuner.places.items():
        print(f"{kind + ':':9s} {path}")
    missing = [agent for agent in found.agents if agent not in {choice.agent for choice in chosen}]
    for agent in missing:
        print(f"no setting of {agent} was chosen: its first trial failed", file=sys.stderr)
    return 1 if missing else 0


def status(
    folder: Annotated[Path, tyro.conf.arg(metavar="[RUNS]")] = Path("runs"),
    /,
    suite: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None,
) -> int:
    """Show how far the sweeps and runs below a folder are: states, failures, time left.

    Args:
        folder: Folder of runs, at any depth, or the folder of one run.
        suite: Only the sweeps of this suite.
    """
    from symsteer.bench.sweep.status import read_status, to_text

    overview = read_status(folder, suite)
    if overview.sweeps or not overview.damage:
        print(printable(to_text(overview.sweeps, folder)))
    for error in overview.damage:
        complain(error, f"error: {error}", 2)
    return 2 if overview.damage else 0


def list_names() -> int:
    """Name the tasks, embodiments, variants, agents, policies, suites and plans."""
    from symsteer.agents import AGENTS
    from symsteer.bench.sweep.grid import read_suite, suite_names
    from symsteer.bench.tasks import EMBODIMENTS, TASKS
    from symsteer.bench.tuning import plan_summaries
    from symsteer.bench.variants import VARIANTS
    from symsteer.policies import POLICIES

    _print_names("tasks (--task)", _summaries(TASKS))
    _print_names("embodiments (--embodiment)", EMBODIMENTS.items())
    _print_names(
        "variants (--variant NAME:STRENGTH, strength in [0, 1]; several joined by +; or none)",
        _summaries(VARIANTS),
    )
    _print_names("agents (--agent)", _summaries(AGENTS))
    _print_names("policies (--policy.name)", _summaries(POLICIES))
    suites = {name: read_suite(name)[0] for name in suite_names()}
    _print_names(
        "suites (symsteer sweep SUITE)",
        ((name, f"{suite.description} ({suite.count} runs)") for name, suite in suites.items()),
    )
    _print_names("tuning plans (symsteer tune PLAN)", plan_summaries().items())
    return 0


def demos(
    path: Annotated[Path, tyro.conf.arg(metavar="FILE")],
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
        count: Number of successful demonstrations.
        mode: clean: as the expert acts. diverse: with correlated noise and offsets, for steering.
        seed: Seed of the collection.
    """
    allow(task)
    from symsteer.bench.demos import collect, load
    from symsteer.terminal import progress_bar

    with progress_bar("demonstrations", count) as advance:
        collect(task, embodiment, count, mode, seed, path, progress=advance)
    steps = load(path, task, embodiment).meta["steps"]
    print(f"wrote {count} demonstrations, {steps} steps, to {path}")
    return 0


def export(run: RunFolder, /, *, out: Path, trust: Trust = ()) -> int:
    """Write the base policy of a run and its demonstrations to one file (docs/bundles.md).

    Args:
        run: Folder of a run; the folder base beside it has the demonstrations.
        out: The file to write (.zip).
    """
    allow(*trust)
    from symsteer.bench.bundles.bundle import write_bundle

    manifest, absent = write_bundle(run, out)
    if absent:
        print(f"the bundle has no demonstrations: {absent}", file=sys.stderr)
    held = [file.path for file in manifest.files]
    print(f"wrote {out} ({out.stat().st_size / 2**20:.1f} MiB): {', '.join(held)}")
    print(f"unpack it anywhere with: {to_paste('symsteer', 'fetch-bundle', out)}")
    return 0


def export_lerobot(
    demos: Annotated[Path, tyro.conf.arg(metavar="DEMOS")],
    /,
    *,
    out: Path,
    videos: Literal["auto", "on", "off"] = "auto",
    trust: Trust = (),
) -> int:
    """Write demonstrations as a LeRobot dataset, version 3.0 (docs/bundles.md).

    Args:
        demos: A file of `symsteer demos`, or of a run in RUNS/base (.h5, its .json beside it).
        out: A new folder.
        videos: Whether the dataset has a video; auto: where a Vulkan driver works.
    """
    allow(*trust)
    with extra("lerobot", "symsteer export-lerobot"):
        from symsteer.bench.bundles.lerobot import write_dataset

    prepare_folder(out.parent)
    print(write_dataset(demos, out, videos))
    return 0


def fetch_bundle(
    file: Annotated[Path, tyro.conf.arg(metavar="FILE")], /, runs: Path = Path("runs")
) -> int:
    """Check a bundle and unpack it to where runs find its demonstrations and base policy.

    Nothing is written unless every file has the hash in the bundle's manifest.

    Args:
        file: The bundle, which `symsteer export` wrote.
        runs: Folder of runs; the files go to RUNS/base.
    """
    from symsteer.bench.bundles.fetch import fetch_bundle

    manifest, places = fetch_bundle(file, runs / "base")
    for kind in ("card", "policy", "demonstrations"):
        if path := manifest.path(kind, ".h5" if kind == "demonstrations" else ""):
            print(f"{kind + ':':16s}{places[path]}")
    for command in manifest.commands(runs / "base"):
        print(f"{'next:':16s}{command}")
    return 0


def audit(
    task: tuple[str, ...] = ("PickCube-v1",),
    embodiment: str = "floating",
    variant: tuple[str, ...] = ("none",),
    group: str = "C8",
    states: int = 32,
    base_policy: Path | None = None,
    out: Path | None = None,
    trust: Trust = (),
) -> int:
    """Measure how broken the symmetry of a task is, in simulation (docs/audit.md).

    Several tasks or variants give a table with a row for each. The same command continues an audit
    that was stopped: what OUT holds already is not measured again.

    Args:
        task: Tasks, or all; `symsteer list` names them.
        embodiment: floating or panda.
        variant: none, name:strength, several of these joined with +, or all:strength.
        group: Symmetry group, e.g. C8, D4 (with reflections).
        states: Number of states of the expert and of the base policy with random noise, each.
        base_policy: Saved base policy, or none: only the expert; default: that of `symsteer run`.
        out: Folder for audit.json and map.png, or for a folder of each cell and the table.
    """
    allow(*task, *variant, *trust)
    from symsteer.bench.audit.report import summary, text, to_markdown, write_table
    from symsteer.bench.audit.result import AuditResult, AuditSettings
    from symsteer.bench.audit.study import cells, run_audits

    visitors: Literal["both", "expert"] = "both"
    if base_policy == Path("none"):
        base_policy, visitors = None, "expert"
    template = AuditSettings(embodiment=embodiment, group=group, states=visitors, count=states)
    wanted = cells(task, variant, template)
    several = len(wanted) > 1

    def done(result: AuditResult) -> None:
        if several:
            _tell(f"{result.settings.name}: {result.seconds:.1f} s")

    results = run_audits(wanted, base_policy=base_policy, out=out, done=done)
    if several and out is not None:
        write_table(results, out)
    if several:
        print(to_markdown([summary(result) for result in results]), end="")
    else:
        print(text(results[0]))
    if out is not None:
        print(f"wrote {out}")
    return 0


def audit_episodes(
    task: str = "PickCube-v1",
    variant: str = "none",
    group: str = "C8",
    episodes: int = 25,
    actions: Literal["expert", "random", "policy"] = "expert",
    base_policy: Path | None = None,
    trust: Trust = (),
) -> int:
    """Compare whole episodes of the floating gripper with their turned copies (docs/tasks.md).

    Args:
        task: Task; `symsteer list` names them.
        variant: How the symmetry is broken, e.g. action_gain:0.5, or none.
        group: Symmetry group, e.g. C8, D4 (with reflections).
        episodes: Number of episodes.
        actions: Who acts. Actions of expert and random are turned; of policy, the noise is.
        base_policy: Saved base policy; default: that of `symsteer run`, kept in runs/base.
    """
    allow(task, variant, *trust)
    from symsteer.bench.audit.result import AuditSettings
    from symsteer.bench.audit.rollout import rotated_rollout_error
    from symsteer.bench.audit.study import audited_policy, cells

    (settings,) = cells([task], [variant], AuditSettings(group=group))
    settings.check()
    if base_policy is not None and actions != "policy":
        raise UserError(f"--actions {actions} does not use --base-policy; leave one of them out")
    actor = audited_policy(settings, base_policy) if actions == "policy" else actions
    error = rotated_rollout_error(
        settings.task, episodes=episodes, actor=actor, group=group, variant=settings.variant
    )
    print(f"{settings.name}, {actions}")
    print(error.summary())
    return 0


def throughput(
    task: str = "PickCube-v1",
    agent: str = "standard",
    num_envs: tuple[int, ...] = (64, 16, 256),
) -> int:
    """Measure how many runs an hour this machine executes, and which setting is fastest.

    It takes one to two minutes. Other programs disturb the measurement, so close them first.

    Args:
        task: Task; `symsteer list` names them.
        agent: Learner; it has its default options.
        num_envs: Numbers of environments.
    """
    allow(task, agent)
    from dataclasses import replace

    import torch

    from symsteer.agents import AGENTS
    from symsteer.bench.sweep.command import choices
    from symsteer.bench.sweep.pool import LocalPool
    from symsteer.bench.sweep.suite import load_suite
    from symsteer.bench.throughput import measure, to_text

    run = load_suite("second").runs[0]
    run = replace(run, task=task, agent=agent, agent_options=AGENTS.get(agent).Options())
    rates = measure(run, choices("cpu", num_envs), LocalPool, _tell)
    if torch.cuda.is_available():
        rates |= measure(run, choices("cuda", num_envs), LocalPool, _tell)
    print(to_text(run, rates))
    return 0


def _tell(line: str) -> None:
    """Print a line of progress."""
    print(printable(line), file=sys.stderr, flush=True)


def _print_places(folder: Path) -> None:
    """Print where the results of a finished run are, and what is wrong with them."""
    from symsteer.leaderboard.records import read_record

    out, record = folder.parent, read_record(folder / "record.json")
    if names := record.not_finite or record.nonfinite_q * "Q":
        print(f"warning: not finite: {names}; see {folder / 'record.json'}", file=sys.stderr)
    print(f"record:      {folder / 'record.json'}")
    print(f"TensorBoard: {to_paste('tensorboard', '--logdir', out)}  then {BOARD}")
    print(f"leaderboard: {to_paste('symsteer', 'report', out, '--out', out / 'leaderboard')}")


def _summaries(registry: Registry[Any]) -> list[tuple[str, str]]:
    return [(name, registry.summary(name)) for name in registry.names()]


def _print_names(title: str, names: Iterable[tuple[str, str]]) -> None:
    """Print names with their summaries, folded to the width of the terminal."""
    print(title)
    for name, text in names:
        print(folded(f"  {name:18s} ", text))
