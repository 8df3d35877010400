"""Sites for the tests: one of ordinary records, one of hostile ones."""

from __future__ import annotations

import shutil
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from symsteer.leaderboard.records import RecordedExtension, RunRecord, write_record
from symsteer.leaderboard.site.build import generate
from symsteer.leaderboard.site.docs import build_documentation
from symsteer.leaderboard.study import PAPER
from tests.leaderboard.record_factory import make_cell, make_curve, make_evaluation, make_record

VIDEO = b"\x00\x00\x00\x18ftypisom" + bytes(64)

EVIL = "<img src=x onerror=\"window.evil=1\"><a href='javascript:window.evil=2'>x</a></script>"
"""Markup that would show itself as an element, and end a block of data."""


def picture() -> bytes:
    """A PNG of one pixel."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", 1, 1, 8, 0, 0, 0, 0)
    data = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\x00\x7f"))
    return b"\x89PNG\r\n\x1a\n" + data + chunk(b"IEND", b"")


def write_all(records: list[RunRecord], folder: Path) -> None:
    for index, record in enumerate(records):
        write_record(record, folder / str(index) / "record.json")


def ordinary_records() -> list[RunRecord]:
    """Two cells of one task and one of another; a run that failed, and one that is set aside."""
    rates: dict[str, Any] = {"base": 0.4, "zero": 0.5, "standard": [0.3, 0.5, 0.6]}
    rates |= {"equivariant": [0.4, 0.7, 0.9]}
    found = make_cell(rates, seeds=5)
    found += make_cell(rates | {"equivariant": 0.2}, seeds=5, variant="action_gain:0.5")
    found += make_cell(rates, seeds=2, task="PushCube-v1", embodiment="panda")
    generator = np.random.default_rng(0)
    for agent in ("standard", "equivariant"):
        curve = make_curve(generator, np.linspace(0.2, 0.8, 5))
        curve[-1].episodes.direction = np.linspace(-3.1, 3.1, 100).tolist()
        found.append(make_record(curve, agent=agent, seed=7, variant="wind:0.2..0.8"))
    curve = make_curve(generator, np.linspace(0.6, 0.1, 5))
    found.append(
        make_record(curve[:3], "failed", agent="standard", seed=8, variant="wind:0.2..0.8")
    )
    again = make_record([make_evaluation([1, 0, 1, 1, 1])], agent="zero", seed=0)
    found.append(again.model_copy(update={"started": again.started.replace(year=2025)}))
    return found


def hostile_records() -> list[RunRecord]:
    """Markup, quotes and control characters in every text, names that leave the folder, names that
    are alike as addresses."""
    names = [
        EVIL,
        "../../../../etc/passwd",
        "a b",
        "a-b",
        "x" * 120,
        "\x00\x1b[31m\u202e\r\n<b>",
        "`|$x$|`[a](https://evil.example)<br>",
        "{{ 7 * 7 }}%{y}&lt;b&gt;",
    ]
    found = []
    for index, name in enumerate(names):
        for agent in ("base", name):
            evaluations = [make_evaluation([1, 0, 1], final=True, q_mean=-5.0, q_magnitude=0.5)]
            record = make_record(evaluations, agent="standard", seed=index)
            changed = record.base_policy.model_copy(
                update={"name": name, "group": name, "warning": name}
            )
            extension = RecordedExtension(
                kind="agent",
                name=name,
                target=name,
                distribution=name,
                version=name,
                sha256="0" * 64,
            )
            texts = {"version": name, "python": name, "platform": name, "device": name}
            provenance = record.provenance.model_copy(
                update={**texts, "packages": {name: name}, "extensions": [extension]}
            )
            places = {"task": name, "embodiment": name, "variant": name, "agent": agent}
            options = {name: name, "preset": name}
            demonstrations = {"mode": name, "count": 50, "seed": 0}
            config = record.config | places | {name: {name: [name, {name: None}]}}
            config |= {"agent_options": options, "demonstrations": demonstrations}
            update: dict[str, Any] = {"base_policy": changed, "provenance": provenance}
            data = record.model_copy(update=update).model_dump(by_alias=True)
            del data["config_hash"]
            role = "reference" if agent == "base" else "learner"
            found.append(RunRecord.model_validate({**data, "config": config, "role": role}))
    failed = make_record(status="failed", seed=99)
    found.append(failed.model_copy(update={"failure": EVIL * 3}))
    return found


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a site of ordinary records, with clips; its records lie in `../runs`."""
    folder = tmp_path_factory.mktemp("site")
    write_all(ordinary_records(), folder / "runs")
    run = folder / "runs" / "0"
    (run / "film-none.mp4").write_bytes(VIDEO)
    (run / "paths-none.png").write_bytes(picture())
    (run / "film-text.mp4").write_text("no film")
    (run / "paths-link.png").symlink_to(run / "paths-none.png")
    generate([folder / "runs"], folder / "site", PAPER, docs=False)
    return folder / "site"


@pytest.fixture(scope="session")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a site of hostile records."""
    folder = tmp_path_factory.mktemp("hostile")
    write_all(hostile_records(), folder / "runs")
    generate([folder / "runs"], folder / "site", PAPER, docs=False)
    return folder / "site"


@pytest.fixture(scope="session")
def whole(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same site with the documentation."""
    out = tmp_path_factory.mktemp("whole") / "site"
    shutil.copytree(site, out)
    build_documentation(out / "docs")
    return out
