"""The study of base policies: every cell once, shared demonstrations, a table that adds up."""

import pytest

from symsteer.bench.runs.base_study import study, table, write_study
from symsteer.errors import UserError
from tests.bench.tiny_run import tiny_config


@pytest.mark.slow
def test_a_small_study(tmp_path):
    names, counts = ("edp", "plain-augmented"), (2,)
    rows = study(tiny_config(), tmp_path, names, counts, seeds=1, episodes=4, workers=1)
    assert [(r["name"], r["count"], r["seed"]) for r in rows] == [
        (name, count, 0) for count in counts for name in names
    ]
    assert all(r["success"] == r["successes"] / 4 for r in rows)
    assert len(list((tmp_path / "base").glob("*.h5"))) == 1
    write_study(tmp_path / "study.json", tiny_config(), rows)
    assert (tmp_path / "study.json").stat().st_size > 500


def test_the_table_gives_mean_and_range():
    rows = [
        {"name": "edp", "count": 5, "seed": s, "success": value}
        for s, value in enumerate((0.2, 0.4, 0.9))
    ]
    assert table(rows).splitlines()[-1] == "| 5 | 0.50 [0.20, 0.90] |"


def test_impossible_numbers_are_refused(tmp_path):
    with pytest.raises(UserError, match="positive"):
        study(tiny_config(), tmp_path, ("edp",), (0,), seeds=1, episodes=1, workers=1)
    for names, counts in (((), (3,)), (("edp",), ())):
        with pytest.raises(UserError, match="at least one"):
            study(tiny_config(), tmp_path, names, counts, seeds=1, episodes=1, workers=1)
