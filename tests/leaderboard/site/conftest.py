"""Sites for the tests: one of ordinary records, one of hostile ones."""

from __future__ import annotations

import io
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imsave

from symsteer.leaderboard.records import RunRecord, write_record
from symsteer.leaderboard.site.build import generate
from symsteer.leaderboard.site.docs import build_documentation
from symsteer.leaderboard.study import PAPER
from tests.leaderboard.record_factory import make_cell, make_curve, make_evaluation, make_record

VIDEO = b"\x00\x00\x00\x18ftypisom" + bytes(64)

SIDE_BY_SIDE = ("PickCube-v1-floating-wind=0.2..0.8", "PickCube-v1-floating-wind=1")
"""Films of a cell that has runs, and of one that has none."""

EVIL = "<img src=x onerror=\"window.evil=1\"><a href='javascript:window.evil=2'>x</a></script>"
"""Markup that would show itself as an element, and end a block of data."""


def picture() -> bytes:
    """A PNG of one pixel."""
    imsave(buffer := io.BytesIO(), np.zeros((1, 1, 3)), format="png")
    return buffer.getvalue()


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


NAMES = (
    EVIL,
    "../../../../etc/passwd",
    "a b",
    "a-b",
    "x" * 120,
    "\x00\x1b[31m\u202e\r\n<b>",
    "`|$x$|`[a](https://evil.example)<br>",
    "{{ 7 * 7 }}%{y}&lt;b&gt;",
)
"""Markup, quotes and control characters, names that leave the folder, names that are alike as
addresses."""

TEXTS = ("name", "group", "warning", "version", "python", "platform", "device", "target")
TEXTS += ("distribution", "task", "embodiment", "variant", "mode", "preset")


def with_name(value: Any, name: str) -> Any:
    """Data of a record with this name in all of its texts."""
    if isinstance(value, dict):
        return {key: name if key in TEXTS else with_name(v, name) for key, v in value.items()}
    return [with_name(one, name) for one in value] if isinstance(value, list) else value


def hostile_records() -> list[RunRecord]:
    """Records with each of `NAMES` in every text."""
    failed = make_record(status="failed", seed=99)
    found = [failed.model_copy(update={"failure": EVIL * 3})]
    for index, name in enumerate(NAMES):
        for role, agent in (("reference", "base"), ("learner", name)):
            curve = [make_evaluation([1, 0, 1], final=True, q_mean=-5.0, q_magnitude=0.5)]
            options = {"agent_options": {name: name, "preset": name}, name: {name: [name, None]}}
            data = make_record(curve, seed=index, **options).model_dump(by_alias=True)
            del data["config_hash"]
            extension = dict.fromkeys(("name", "target", "distribution", "version"), name)
            data = with_name(data, name) | {"role": role}
            data["config"]["agent"] = agent
            data["provenance"]["packages"] = {name: name}
            data["provenance"]["extensions"] = [extension | {"kind": "agent", "sha256": "0" * 64}]
            found.append(RunRecord.model_validate(data))
    return found


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a site of ordinary records, with films; its records lie in `../runs`."""
    folder = tmp_path_factory.mktemp("site")
    write_all(ordinary_records(), folder / "runs")
    run = folder / "runs" / "0"
    for place in (run / "film-none", *(folder / "runs" / f"film-{name}" for name in SIDE_BY_SIDE)):
        place.with_name(f"{place.name}.mp4").write_bytes(VIDEO)
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
