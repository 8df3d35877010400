"""Learners and base policies on a GPU, with physics on the CPU."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import symsteer
from symsteer.agents import AGENTS
from symsteer.agents.sac import can_join
from symsteer.bench.runs.base_policy import prepare_base
from symsteer.bench.runs.folder import run_id
from symsteer.bench.runs.run import evaluate
from symsteer.bench.runs.together import execute_together
from symsteer.leaderboard.records import read_record
from symsteer.policies import POLICIES
from tests.bench.tiny_run import execute, quiet, resume, stop, tiny_config
from tests.marks import policy_class

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA"),
]
TEAMS = [name for name in AGENTS.builtin if can_join(AGENTS.get(name))]


@pytest.fixture(scope="session")
def bases(tmp_path_factory) -> Path:
    """A folder with the base policies of tiny runs with seeds 0 and 1, trained on the GPU."""
    out = tmp_path_factory.mktemp("bases")
    for seed in (0, 1):
        prepare_base(tiny_config(seed=seed, device="cuda"), quiet(runs=out))
    return out / "base"


@pytest.fixture
def out(bases, tmp_path) -> Path:
    (tmp_path / "base").symlink_to(bases)
    return tmp_path


def without_gpu(*args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "symsteer", *args],
        env={**os.environ, "CUDA_VISIBLE_DEVICES": ""},
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.mark.parametrize("name", AGENTS.builtin)
def test_every_agent_runs_and_is_restored(name, out):
    config = tiny_config(name, device="cuda")
    folder = execute(config, out)
    record = read_record(folder / "record.json")
    assert record.status == "finished"
    assert record.provenance.device == torch.cuda.get_device_name()
    trained = symsteer.load(folder)
    assert trained.agent.device.type == "cuda"
    actions = trained.act(torch.randn(3, trained.policy.obs_layout.dim))
    assert actions.device.type == "cpu"
    assert actions.isfinite().all()
    if record.budget.updates:
        assert record.final.diagnostics["equivariance_decode"] < 1e-4
    if name == "equivariant":
        assert record.final.diagnostics["equivariance_actor"] < 1e-3


@pytest.mark.parametrize("name", POLICIES.builtin)
def test_every_policy_decodes_as_on_the_cpu(name, tmp_path):
    policy_class(name)
    config = tiny_config(policy_name=name, device="cuda")
    policy = prepare_base(config, quiet(runs=tmp_path))
    assert policy.device.type == "cuda"
    generator = torch.Generator().manual_seed(0)
    obs = 0.1 * torch.randn(16, policy.obs_layout.dim, generator=generator)
    noise = torch.randn(16, policy.horizon, policy.act_layout.dim, generator=generator)
    found = policy.decode(obs.cuda(), noise.cuda()).cpu()
    torch.testing.assert_close(found, policy.to("cpu").decode(obs, noise), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", TEAMS)
def test_teams_train(name, out):
    configs = [tiny_config(name, seed=seed, device="cuda") for seed in (0, 1)]
    assert execute_together(configs, quiet(runs=out)) == [None, None]
    for config in configs:
        record = read_record(out / run_id(config, {}) / "record.json")
        assert (record.status, record.provenance.together) == ("finished", 2)


def test_a_stopped_run_goes_on(out):
    config = tiny_config(device="cuda", env_steps=320, checkpoint_every=40)
    folder = stop(config, out, env_steps=160)
    assert read_record(resume(folder) / "record.json").status == "finished"


def test_a_run_is_used_where_there_is_no_gpu(out):
    """It is evaluated on the CPU; it is not continued there, and nothing is lost."""
    folder = execute(tiny_config(device="cuda"), out)
    here = evaluate(folder)
    assert here.recorded is None
    done = without_gpu("evaluate", str(folder), "--json")
    assert done.returncode == 0, done.stderr
    elsewhere = json.loads(done.stdout)
    assert elsewhere["recorded"] is None
    assert elsewhere["episodes"]["seed"] == here.evaluation.episodes.seed
    config = tiny_config(seed=1, device="cuda", env_steps=320, checkpoint_every=40)
    stopped = stop(config, out, env_steps=160)
    refused = without_gpu("resume", str(stopped))
    assert refused.returncode != 0
    assert "was begun with --device cuda, but torch finds no CUDA device" in refused.stderr
    assert "Traceback" not in refused.stderr
    assert read_record(resume(stopped) / "record.json").status == "finished"
