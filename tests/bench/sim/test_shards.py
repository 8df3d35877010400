"""Environments in several processes equal those in one process; how the processes end."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
import time
from typing import Any

import psutil
import pytest
import torch
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv

from symsteer.bench.sim.errors import WorkerError, WorkerLostError
from symsteer.bench.sim.parallel import create
from symsteer.bench.sim.trees import rows_of
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.tasks import make
from symsteer.bench.variants import VARIANTS
from symsteer.errors import UserError
from tests.bench.shared import assert_same
from tests.bench.steering.test_latent_env import NoiseIsAction

TASK = "PickCube-v1"


def both(num_envs: int, workers: int = 2, **options: Any) -> tuple[Any, Any]:
    """The same environments in one process and in several."""
    task = options.pop("task", TASK)
    one = make(task, num_envs=num_envs, **options)
    return one, make(task, num_envs=num_envs, workers=workers, **options)


def actions(steps: int, num_envs: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    low = torch.rand(steps, num_envs, 7, generator=generator) * 2 - 1
    low[: steps // 2, :, 2] = -1  # down, where there are contacts
    return low


@pytest.fixture(scope="module")
def pair():
    """Uneven shards, strengths of their own, zero among them."""
    strengths = torch.tensor([0.0, 0.3, 0.5, 0.0, 1.0])
    one, two = both(5, variant="action_gain", strength=strengths, reward_mode="dense")
    yield one, two
    two.close()


def test_same_trajectories(pair):
    """Seeds of every kind, partial resets in any order, contacts, per-environment strengths."""
    resets = {
        0: {"seed": 3},
        4: {"seed": [8, 9], "options": {"env_idx": torch.tensor([4, 1])}},
        7: {"options": {"env_idx": torch.tensor([0])}},
        9: {"seed": 5, "options": {"env_idx": torch.tensor([3, 0, 2])}},
        11: {"seed": [1, 2, 3, 4, 5], "options": {"reconfigure": True}},
        14: {"seed": None},
        16: {"options": {"reconfigure": True}},
    }
    for step, action in enumerate(actions(18, 5)):
        if step in resets:
            assert_same(*(env.reset(**resets[step]) for env in pair))
            assert_same(*(env.get_state_dict() for env in pair))
        if step in (5, 8):
            for env in pair:
                env.pause(torch.tensor([step == 5, False, False, step == 5, False]))
        seen, kept = (env.step(action) for env in pair)
        assert_same(seen, kept)
        assert_same(*(env.elapsed_steps for env in pair))
    assert_same(*(env.get_info() for env in pair))
    obs, again = (env.get_obs() for env in pair)
    assert_same(obs, again)
    pair[1].step(action)
    assert_same(obs, again)  # a result is the caller's own


def test_same_before_the_first_reset_and_other_kinds_of_action():
    one, two = both(3, obs_mode="state_dict")
    assert_same(one.get_obs(), two.get_obs())
    mode = {"control_mode": "pd_joint_delta_pos", "action": torch.full((3, 7), 0.2)}
    for action in (None, actions(1, 3)[0].numpy().astype("f8"), mode):
        assert_same(one.step(action), two.step(action))
    two.close()


def test_same_interface(pair):
    one, two = pair
    for name in ("single_observation_space", "observation_space"):
        assert getattr(one, name).shape == getattr(two, name).shape
    for name in (
        *("single_action_space", "action_space", "num_envs", "device", "obs_mode", "reward_mode"),
        *("control_mode", "embodiment", "body", "max_episode_steps", "task_id", "action_layout"),
        *("observation_layout", "control_freq", "workspace_center", "robot_uids"),
    ):
        assert getattr(one, name) == getattr(two, name), name
    assert one.feasible_return(0.9, 4) == two.feasible_return(0.9, 4)
    assert_same(one.variants[0].strength, two.variants[0].strength)
    for name in ("agent", "cube", "transform_state", "step_nothing"):
        with pytest.raises(UserError, match=rf"env\.{name} exists in .* workers=1"):
            getattr(two, name)
        assert not hasattr(two, name)


def test_states(pair):
    """Save and restore, for all and for some environments in any order."""
    one, two = pair
    for env in pair:
        env.reset(seed=[4, 5, 6, 7, 8])
        for action in actions(6, 5):
            env.step(action)
    state, index = one.get_state_dict(), torch.tensor([4, 0, 2])
    turned = one.transform_state(state, 1.0, True)
    some, first = rows_of(turned, [0, 2, 4]), one.get_state()[:1]
    del some["controller"]
    for restore in (
        lambda env: env.get_state(),
        lambda env: env.set_state_dict(turned),
        lambda env: env.set_state_dict(some, env_idx=index),
        lambda env: env.set_state(first, env_idx=torch.tensor([3])),
        lambda env: env.step(actions(1, 5)[0]),
    ):
        assert_same(restore(one), restore(two))
        assert_same(one.get_state_dict(), two.get_state_dict())


def test_all_variants_and_the_arm():
    """Every variant at once, each with its own reset and forces, also for the panda arm."""
    variant = "+".join(f"{name}:0.4" for name in sorted(VARIANTS))
    one, two = both(3, task="StackCube-v1", embodiment="panda", variant=variant, workers=3)
    assert_same(one.reset(seed=1), two.reset(seed=1))
    for step, action in enumerate(actions(6, 3)):
        if step == 4:
            partial = {"seed": [7], "options": {"env_idx": torch.tensor([1])}}
            assert_same(one.reset(**partial), two.reset(**partial))
        assert_same(one.step(action), two.step(action))
    two.close()


def test_same_latent_noise_environment():
    """Successes within a chunk, in some and in all environments, and time limits."""
    one, two = both(4)
    pairs = [LatentNoiseEnv(env, NoiseIsAction(4)) for env in (one, two)]
    noise = torch.randn(14, 4, 4, 7, generator=torch.Generator().manual_seed(0))
    noise[0] = 0
    for solved, decisions in (([1, 3], 14), ([0, 1, 2, 3], 2)):
        assert_same(*(env.reset([3, 4, 5, 6]) for env in pairs))
        state = one.get_state_dict()
        # Cubes that lie in their goals, and hands that do not move.
        state["actors"]["goal_site"][solved, :3] = state["actors"]["cube"][solved, :3]
        for env in (one, two):
            env.set_state_dict(state)
        for i, w in enumerate(noise[:decisions]):
            ours, theirs = (vars(env.step(w)) for env in pairs)
            assert_same(ours, theirs)
            if i == 0:
                assert ours["terminal"].nonzero().flatten().tolist() == solved
        assert pairs[0].control_steps == pairs[1].control_steps
    two.close()


def test_stock_tasks_do_not_repeat_themselves():
    """Without a seed, workers draw different episodes of tasks that use torch's generator."""
    env = create(PickCubeEnv, 2, workers=2, robot_uids="panda", obs_mode="state")
    env.reset()
    cubes = env.get_state_dict()["actors"]["cube"][:, :2]
    assert not torch.equal(cubes[0], cubes[1])
    env.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"workers": 5}, "at most the number of environments, 4"),
        ({"workers": 2, "sim": "cuda"}, "leave workers out"),
        (
            {"workers": 2, "variant": "action_gain", "strength": torch.ones(3)},
            "3 strengths",
        ),
        ({"workers": 2, "control_mode": "pd_ee_body_pose"}, "pd_ee_body_pose"),
        ({"workers": 2, "robot_uids": lambda: None}, "cannot be sent"),
    ],
)
def test_bad_options(options, words):
    with pytest.raises((UserError, WorkerError), match=words):
        make(TASK, num_envs=4, **options)


def test_bad_input(pair):
    two = pair[1]
    before = two.get_state_dict()
    partial = {"env_idx": torch.tensor([1]), "reconfigure": True}
    for use, words in (
        (lambda: two.step(torch.zeros(4, 7)), "one row of actions for each of the 5"),
        (lambda: two.step([[0.0] * 7] * 5), "not a list"),
        (lambda: two.reset(seed=[1, 2, 3]), "3 seeds were given for 5"),
        (lambda: two.reset(options=partial), "env_idx or reconfigure"),
    ):
        with pytest.raises(UserError, match=words):
            use()
    assert_same(two.get_state_dict(), before)


class Local(PickCubeEnv):
    """Fails when it is told to."""

    def evaluate(self):
        if self.elapsed_steps.max() == 1 and self.num_envs == 1:
            raise UserError("this task takes one step")
        if self.elapsed_steps.max() == 2:
            raise ZeroDivisionError("two steps are too many")
        return super().evaluate()


def test_errors_of_a_worker():
    """A mistake is raised as itself, another error with the worker's traceback; the environment
    goes on after both, and later answers are not mixed up."""
    env = create(Local, 3, workers=2, robot_uids="panda", obs_mode="state")
    dim = env.action_space.shape[1]
    env.reset(seed=1)
    with pytest.raises(UserError, match="takes one step"):
        env.step(torch.zeros(3, dim))
    # The messages are locals of a frame that the error keeps. Python 3.12 crashes where views of
    # their buffers are garbage.
    gc.collect()
    with pytest.raises(WorkerError, match=r"worker 1 of 2 .*ZeroDivisionError: two") as raised:
        env.step(torch.zeros(3, dim))
    assert "in evaluate" in raised.value.__notes__[0]
    assert env.reset(seed=1)[0].shape[0] == 3
    env.close()
    with pytest.raises(UserError, match="closed"):
        env.step(torch.zeros(3, dim))
    env.close()


def test_an_interrupted_request_ends_the_workers(monkeypatch):
    """Its answers may still arrive, and would be taken for later ones."""
    env = make(TASK, num_envs=2, workers=2)
    with monkeypatch.context() as interrupted:
        interrupted.setattr("pickle.loads", lambda data: signal.raise_signal(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            env.reset(seed=1)
    with pytest.raises(UserError, match="because KeyboardInterrupt interrupted it"):
        env.reset(seed=1)


def test_local_classes_are_refused():
    with pytest.raises(UserError, match="import the task class"):
        create(type("Mine", (PickCubeEnv,), {"__module__": "__main__"}), 2, workers=2)


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def wait_until_gone(pids: list[int], seconds: float = 20) -> None:
    end = time.monotonic() + seconds
    while any(map(psutil.pid_exists, pids)):
        assert time.monotonic() < end, "processes are left"
        time.sleep(0.05)


@pytest.mark.parametrize("when", ["between", "during"])
def test_a_killed_worker_is_reported(when):
    before = open_files()
    env = make(TASK, num_envs=4, workers=2)
    env.reset(seed=1)
    pids = env.worker_pids
    if when == "during":
        os.kill(pids[1], signal.SIGSTOP)  # it will not have answered when it dies
        threading.Timer(0.3, os.kill, (pids[1], signal.SIGKILL)).start()
    else:
        os.kill(pids[1], signal.SIGKILL)
        wait_until_gone(pids[1:])
    with pytest.raises(WorkerLostError, match=r"worker 2 of 2 \(environments 2 to 3\) .*SIGKILL"):
        env.step(torch.zeros(4, 7))
    wait_until_gone(pids)
    assert open_files() == before
    with pytest.raises(UserError, match="worker 2 of 2"):
        env.reset()


def test_interrupts_are_the_callers_and_nothing_is_left_behind():
    """Closed, deleted or never finished: no process and no file descriptor is left.

    Ctrl-C reaches all processes of a terminal, and the workers leave it to the caller.
    """
    make(TASK, num_envs=2, workers=2).close()  # the server that starts workers keeps its files
    before = open_files()
    env = make(TASK, num_envs=2, workers=2)
    pids = env.worker_pids
    for pid in pids:
        os.kill(pid, signal.SIGINT)
    env.reset(seed=1)
    del env
    wait_until_gone(pids)
    with pytest.raises(WorkerError):
        make(TASK, num_envs=2, workers=2, reward_mode="generous")
    assert open_files() == before


PROGRAM = f"""
import torch
from symsteer.bench.tasks import make
env = make("{TASK}", num_envs=2, workers=2)
env.reset(seed=1)
print(*env.worker_pids, flush=True)
while True:
    env.step(torch.zeros(2, 7))
"""


@pytest.mark.slow
def test_workers_end_with_the_program(tmp_path):
    """It was killed. It has no guard against being imported by its workers."""
    script = tmp_path / "program.py"
    script.write_text(PROGRAM)
    with subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.getcwd()},
    ) as program:
        pids = [int(pid) for pid in program.stdout.readline().split()]
        program.kill()
    assert len(pids) == 2
    wait_until_gone(pids)
