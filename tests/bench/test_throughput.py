"""`symsteer throughput`: the parts of a step of a run."""

import pytest

from symsteer.bench.throughput import measure, table
from symsteer.errors import UserError


def test_a_step_of_a_run_is_measured_by_part():
    lines: list[str] = []
    rows = measure("PickCube-v1", "standard", (2, 4), (1,), 0.2, lines.append)
    assert [(row["num_envs"], row["workers"]) for row in rows] == [(2, 1), (4, 1)]
    assert len(lines) == 2
    for row in rows:
        parts = [row[part] for part in ("simulate", "decode", "learn")]
        assert min(parts) > 0
        # Milliseconds of a step of all environments, which the rate counts one by one.
        assert sum(parts) == pytest.approx(1e3 * row["num_envs"] / row["rate"], rel=0.01)
    assert len(table(rows).splitlines()) == 3


@pytest.mark.parametrize("numbers", [((0,), (1,), 1.0), ((4,), (1,), 0.0), ((4,), (10_000,), 1.0)])
def test_numbers_out_of_range(numbers):
    with pytest.raises(UserError):
        measure("PickCube-v1", "standard", *numbers)
