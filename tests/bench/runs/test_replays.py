"""What a run keeps of its decisions."""

import pytest

from symsteer.agents import AGENTS
from symsteer.bench.runs.replays import FIELDS, store_replay, stored_replay
from symsteer.errors import UserError
from tests.agents.conftest import Problem

WITH_REPLAY = [name for name in AGENTS.builtin if AGENTS.get(name).role != "reference"]


@pytest.mark.parametrize("name", WITH_REPLAY)
def test_every_learner_keeps_whole_decisions(tmp_path, name):
    problem = Problem()
    agent = problem.agent(name)
    with pytest.raises(UserError, match="--keep-replay"):
        stored_replay(tmp_path)
    agent.observe(problem.transition(6, rows=agent.rows))
    store_replay(agent.replay, tmp_path)
    found = stored_replay(tmp_path)
    assert {field: len(found[field]) for field in FIELDS} == dict.fromkeys(FIELDS, 6)
