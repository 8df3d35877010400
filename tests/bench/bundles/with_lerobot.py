"""Runs where lerobot is installed: reads a dataset; trains a policy on it and evaluates that.

Arguments: the dataset's folder, the file for what was found (JSON), and, to train, ``env.py``.
"""

import json
import sys
from pathlib import Path

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.utils import _call_make_env, _load_module_from_path, _normalize_hub_result
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.processor.pipeline import PolicyProcessorPipeline
from lerobot.scripts.lerobot_eval import rollout

CHUNK = 4
SMALL = {
    "chunk_size": CHUNK,
    "n_action_steps": CHUNK,
    "dim_model": 16,
    "n_heads": 2,
    "dim_feedforward": 16,
    "n_encoder_layers": 1,
    "use_vae": False,
}


def read(root: Path) -> dict:
    """The dataset as lerobot sees it."""
    name, options = "local/demonstrations", {"root": root, "video_backend": "pyav"}
    dataset = LeRobotDataset(name, **options)
    second = LeRobotDataset(name, episodes=[1], **options)
    first = dataset[0]
    begins = [0, dataset.meta.episodes["length"][0]]
    return {
        "episodes": dataset.num_episodes,
        "frames": len(dataset),
        "lengths": list(dataset.meta.episodes["length"]),
        "fps": dataset.fps,
        "task": first["task"],
        "shapes": {k: list(v.shape) for k, v in first.items() if torch.is_tensor(v)},
        "actions": [second[i]["action"].tolist() for i in range(len(second))],
        "stats": {k: v.tolist() for k, v in dataset.meta.stats["action"].items()},
        "pictures": {k: [dataset[i][k].tolist() for i in begins] for k in dataset.meta.video_keys},
    }


def train_and_evaluate(root: Path, env_file: Path) -> dict:
    """Two updates of ACT on all that the dataset has, then two episodes."""
    deltas = {"action": [i / 20 for i in range(CHUNK)]}
    dataset = LeRobotDataset("local/demonstrations", root=root, delta_timestamps=deltas)
    config = ACTConfig(device="cpu", push_to_hub=False, pretrained_backbone_weights=None, **SMALL)
    policy = make_policy(config, ds_meta=dataset.meta)
    before, after = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    optimizer = torch.optim.Adam(policy.parameters(), lr=1e-3)
    losses = []
    for batch in torch.utils.data.DataLoader(dataset, batch_size=8):
        loss, _ = policy.forward(before(batch))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
        if len(losses) == 2:
            break
    made = _call_make_env(_load_module_from_path(str(env_file)), 2, False, None)
    ((task, numbered),) = _normalize_hub_result(made).items()
    policy.eval()
    nothing = PolicyProcessorPipeline(steps=[])
    played = rollout(numbered[0], policy, nothing, nothing, before, after, seeds=[1, 2])
    numbered[0].close()
    return {
        "losses": losses,
        "env": task,
        "played": {k: list(v.shape) for k, v in played.items() if torch.is_tensor(v)},
        "done": played["done"][:, -1].tolist(),
    }


if __name__ == "__main__":
    root, out, *env_files = map(Path, sys.argv[1:])
    found = read(root)
    for env_file in env_files:
        found |= train_and_evaluate(root, env_file)
    out.write_text(json.dumps(found))
