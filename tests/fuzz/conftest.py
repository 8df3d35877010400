"""Intact inputs of every kind: a stopped run, its demonstrations and policy, some records."""

from __future__ import annotations

from unittest.mock import patch

import pytest

from symsteer.bench.bundles.bundle import write_bundle
from symsteer.bench.runs.checkpoint import load_checkpoint
from symsteer.bench.runs.trainer import Trainer
from symsteer.leaderboard.records import dump_record
from tests.bench.tiny_run import execute, tiny_config
from tests.fuzz.kinds import Workshop
from tests.leaderboard.record_factory import make_record

CONFIG = tiny_config(agent="standard", env_steps=320, checkpoint_every=20)


def stop_after(config, out, checkpoints):
    """The folder of a run that was interrupted right after some checkpoint."""
    written = []

    def save(trainer):
        whole(trainer)
        written.append(trainer.folder)
        if len(written) == checkpoints:
            raise KeyboardInterrupt

    whole = Trainer._checkpoint
    with patch.object(Trainer, "_checkpoint", save), pytest.raises(KeyboardInterrupt):
        execute(config, out)
    return written[0]


@pytest.fixture(autouse=True)
def nothing_is_committed(monkeypatch, tmp_path):
    """`report --check` reads all committed records, a thousand of them."""
    monkeypatch.setattr("symsteer.leaderboard.command.RECORDS", tmp_path / "committed")


@pytest.fixture(scope="session")
def workshop(tmp_path_factory) -> Workshop:
    out = tmp_path_factory.mktemp("workshop")
    folder = stop_after(CONFIG, out, checkpoints=2)
    write_bundle(folder, out / "bundle.zip")
    state = load_checkpoint(folder)
    assert state is not None
    records = {
        "a": make_record(agent="standard"),
        "b": make_record(agent="equivariant", seed=1),
        "c": make_record(agent="base", status="failed"),
    }
    texts = {name: dump_record(record) for name, record in records.items()}
    return Workshop(CONFIG, folder, state, texts)
