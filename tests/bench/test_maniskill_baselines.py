"""ManiSkill's own training scripts on our ids: the commands of docs/baselines.md, made small.

The scripts are in ManiSkill's repository only: MANISKILL_CHECKOUT names a checkout of it.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

CHECKOUT = Path(os.environ.get("MANISKILL_CHECKOUT", "nowhere")).resolve()
PAGE = (Path(__file__).parents[2] / "docs" / "baselines.md").read_text()
OURS = "symsteer.bench.tasks:SymSteer/"

pytestmark = pytest.mark.skipif(
    not (CHECKOUT / "examples" / "baselines").is_dir(),
    reason="MANISKILL_CHECKOUT names no checkout of ManiSkill",
)

POLICY = (
    "--total-iters 3 --batch-size 16 --num-eval-envs 2 --num-eval-episodes 2 --eval-freq 2 "
    "--log-freq 1 --unet-dims 8 16 --max-episode-steps 8"
)
SAC = (
    "--num-envs 2 --num-eval-envs 2 --buffer-size 500 --batch-size 16 --total-timesteps 256 "
    "--learning-starts 128 --eval-freq 128 --log-freq 64"
)


def command(word):
    """The line of the page with a word, continued lines joined."""
    lines = re.sub(r"\\\n\s*", "", PAGE).splitlines()
    (line,) = [line for line in lines if word in line and not line.startswith(("-", "`"))]
    return line


def run(line, folder):
    """Run a line of the page as a user does, in an empty folder."""
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONWARNINGS": "ignore",
    }
    line = line.replace("ManiSkill/examples", f"{CHECKOUT}/examples")
    line = line.replace("PYTHONPATH=", f"PYTHONPATH={folder}:")
    done = subprocess.run(
        ["bash", "-c", line], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


def scalars(folder):
    """All that a script logged: the last value of each name."""
    (file,) = folder.rglob("events.out.tfevents.*")
    events = EventAccumulator(str(file)).Reload()
    return {name: events.Scalars(name)[-1].value for name in events.Tags()["scalars"]}


@pytest.fixture
def place(tmp_path):
    (block,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    (tmp_path / "lab.py").write_text(block)
    return tmp_path


@pytest.mark.parametrize("env_id", [f"{OURS}PickCube-v1", "lab:Lab/WeakPick-v1"])
def test_the_diffusion_policy_trains_and_is_evaluated(place, env_id):
    run(command("symsteer demos") + " --count 3", place)
    run(f"{command('diffusion_policy/train.py')} {POLICY} --env-id {env_id}", place)
    logged = scalars(place / "runs")
    assert 0 <= logged["eval/success_once"] <= 1
    assert logged["eval/episode_len"] == 8
    assert 0 < logged["losses/total_loss"] < 10


def test_sac_trains_and_is_evaluated(place):
    run(command("sed 's"), place)
    run(f"{command('python sac_cpu.py')} {SAC}", place)
    logged = scalars(place / "runs")
    assert logged["eval/episode_len"] == 50
    assert logged["eval/return"] > 0
    assert logged["losses/qf_loss"] > 0
    (checkpoint,) = place.rglob("final_ckpt.pt")
    weights = torch.load(checkpoint, weights_only=True)["actor"]
    assert all(torch.isfinite(value).all() for value in weights.values())
