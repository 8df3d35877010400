"""Suites as data: products, defaults, mistakes."""

import pytest

from symsteer.bench.runs.config import build_config
from symsteer.bench.sweep.suite import load_suite, suite_names
from symsteer.errors import UserError


def write(tmp_path, text: str) -> str:
    path = tmp_path / "suite.toml"
    path.write_text(text)
    return str(path)


def test_the_grid_is_a_product_over_shared_settings(tmp_path):
    suite = load_suite(
        write(
            tmp_path,
            """
            description = "two by two"
            [grid]
            agent = ["base", "standard"]
            seed = [3, 4]
            [run]
            env_steps = 77
            [run.sac]
            width = 32
            """,
        )
    )
    assert [(c.agent, c.seed) for c in suite.runs] == [
        ("base", 3),
        ("base", 4),
        ("standard", 3),
        ("standard", 4),
    ]
    assert {c.env_steps for c in suite.runs} == {77}
    assert {c.sac.width for c in suite.runs} == {32}
    assert suite.runs[0].sac.gamma == build_config({}, "").sac.gamma


def test_every_suite_that_ships_can_be_read():
    assert "demo" in suite_names()
    for name in suite_names():
        suite = load_suite(name)
        assert suite.runs
        assert suite.description


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[grid]\nagnt = ['base']", "did you mean agent"),
        ("[run.sac]\ngama = 0.9", "did you mean sac.gamma"),
        ("[run]\nenv_steps = 'many'", "env_steps"),
        ("[run]\nsac = 3", "must be a table"),
        ("[grid]\nseed = []", "at least one value"),
        ("[run]\nenv_steps = 0", "between 1 and"),
        ("[run]\nseed = 2026-01-31", "must be a number"),
        ("[run.sac]\nlr = inf", "sac.lr is inf"),
        ("[grid]\nseed = " + "[" * 5000, "cannot be read as TOML"),
        (f"[grid]\nseed = {list(range(1000))}\nnum_envs = {list(range(1000))}", "has 1000000 runs"),
        ("not toml", "cannot be read as TOML"),
        ("grid = []", "has no runs"),
        ("colour = 'red'", "there is no key 'colour'"),
    ],
)
def test_mistakes_in_a_suite(text, words, tmp_path):
    with pytest.raises(UserError, match=words):
        load_suite(write(tmp_path, text))


def test_an_unknown_suite_lists_the_known_ones():
    with pytest.raises(UserError, match="demo"):
        load_suite("dmeo")


def test_a_dial_may_begin_at_zero(tmp_path):
    text = "[grid]\nvariant = ['action_gain', 'wind']\nstrength = [0, 0.5]"
    suite = load_suite(write(tmp_path, text))
    assert [c.variant for c in suite.runs] == ["none", "action_gain:0.5", "wind:0.5"]
