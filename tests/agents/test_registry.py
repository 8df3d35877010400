"""Agents are found by themselves: one file in the package is all that a new one needs."""

import sys

import pytest
import torch

import symsteer.agents
from symsteer.agents import make_agent, registry
from symsteer.agents.sac import SacAgent
from symsteer.errors import UserError

MINE = '''
"""A file as a user would write it."""
from symsteer.agents.equivariant import equivariant_critic_layers
from symsteer.agents.standard import StandardAgent

class _Helper(StandardAgent):
    name = "standard"

class Mine(_Helper):
    """Half of the symmetry."""
    name = "mine"
    def critic_layers(self):
        return equivariant_critic_layers(self)

class AlsoMine(Mine):
    name = "also-mine"
'''


@pytest.fixture
def add(monkeypatch, tmp_path):
    """Puts files into the package of agents, for the length of a test."""
    monkeypatch.setattr(symsteer.agents, "__path__", [*symsteer.agents.__path__, str(tmp_path)])
    before = set(sys.modules)

    def write(name, text):
        (tmp_path / name).write_text(text)
        registry.cache_clear()

    yield write
    for name in set(sys.modules) - before:
        if name.startswith("symsteer.agents."):
            del sys.modules[name]
            vars(symsteer.agents).pop(name.removeprefix("symsteer.agents."), None)
    registry.cache_clear()


def test_the_order_is_that_of_a_comparison():
    names = list(symsteer.agents.AGENTS)
    assert names[:4] == ["standard", "standard-matched", "equivariant", "approximate"]
    learners = [name for name in names if symsteer.agents.AGENTS[name].learns]
    assert names[: len(learners)] == learners
    assert names[len(learners) :][:2] == ["base", "zero"]
    assert all(symsteer.agents.AGENTS[name].name == name for name in names)


def test_a_new_file_is_a_new_agent(add, problem):
    add("mine.py", MINE)
    assert list(symsteer.agents.AGENTS)[4:7] == ["also-mine", "mine", "base"]
    agent = make_agent("mine", problem.obs_layout, problem.act_layout, problem.horizon)
    assert isinstance(agent, SacAgent)
    assert type(agent).__module__ == "symsteer.agents.mine"
    batch = problem.batch()
    turned = agent.obs_layout.transform(batch.obs, torch.pi / 4)
    noise = agent.act_layout.transform(batch.noise, torch.pi / 4)
    values, turned_values = agent.q_values(batch.obs, batch.noise), agent.q_values(turned, noise)
    assert torch.allclose(values, turned_values, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (MINE.replace('"also-mine"', '"zero"'), r"mine\.py: AlsoMine and agents/references\.py"),
        (MINE.replace('    name = "also-mine"', "    pass"), r"both called 'mine'"),
        (MINE.replace('"also-mine"', '"../mine"'), r"AlsoMine has the name '\.\./mine'; use"),
        (MINE.replace('"also-mine"', '""'), r"letters, digits"),
        (MINE.replace('"also-mine"', f'"{"m" * 61}"'), r"at most 60"),
        (
            'class Bare:\n    name = "bare"\n',
            r"Bare has a name but is no agent; inherit .*SacAgent",
        ),
        ("import nothing_of_the_sort\n", r"ModuleNotFoundError.*line 1\); mend or remove it"),
        ("class Mine(\n", r"agents/mine\.py cannot be imported \(SyntaxError"),
    ],
)
def test_what_cannot_be_an_agent_is_named(add, text, sentence):
    add("mine.py", text)
    with pytest.raises(UserError, match=sentence):
        _ = symsteer.agents.AGENTS


def test_a_damaged_file_does_not_keep_the_package_from_being_imported(add):
    add("mine.py", "1 / 0\n")
    with pytest.raises(UserError, match=r"mine\.py.*ZeroDivisionError"):
        registry()
    with pytest.raises(UserError, match="mend or remove it"):
        make_agent("zero", None, None, 1)
    with pytest.raises(AttributeError, match="no attribute 'AGENT'"):
        _ = symsteer.agents.AGENT
