"""The choice between trials."""

import pytest

from symsteer.errors import UserError
from tools.pages.dial import Trial, below_best, complete, loss, main, render, shared


def trials(values):
    """Success and area by agent, world and base policy."""
    return [
        Trial(agent, "dial", world, seed, area, success, 60.0)
        for (agent, world), pairs in values.items()
        for seed, (success, area) in enumerate(pairs)
    ]


VALUES = {
    ("standard", "none"): [(0.8, 0.5), (0.6, 0.5)],
    ("slow", "none"): [(0.8, 0.53), (0.8, 0.53)],
    ("standard", "bias"): [(0.5, 0.4), (0.5, 0.4)],
    ("slow", "bias"): [(0.4, 0.4), (0.4, 0.4)],
}


def test_a_loss_is_the_largest_regret_in_units_of_what_may_be_lost():
    of_candidate = below_best(complete(trials(VALUES)))
    standard, slow = (of_candidate[name, "dial"] for name in ("standard", "slow"))
    assert standard["none"] == pytest.approx((0.1, 0.03))
    assert slow["bias"] == pytest.approx((0.1, 0.0))
    assert loss(standard) == pytest.approx(2.0)
    assert [row.split()[1] for row in render(trials(VALUES)).splitlines()[2:]] == [
        "`slow`",
        "`standard`",
    ]


def test_only_settings_with_all_worlds_and_base_policies_are_compared():
    more = [*trials(VALUES), Trial("free-bias", "dial", "none", 0, 1.0, 1.0, 60.0)]
    assert below_best(complete(more)) == below_best(complete(trials(VALUES)))
    with pytest.raises(UserError, match="no setting was tried in all worlds"):
        complete([*more, Trial("free-bias", "dial", "none", 7, 0.0, 0.0, 60.0)])


def test_a_setting_that_all_share_is_chosen_by_the_mean_over_agents():
    """One agent loses .1 by it, the other one gains .3."""
    success = {
        ("standard", "a"): 0.5,
        ("standard", "b"): 0.6,
        ("slow", "a"): 0.8,
        ("slow", "b"): 0.5,
    }
    runs = [Trial(*key, "none", 0, 0.5, value, 60.0) for key, value in success.items()]
    of_candidate = below_best(complete(shared(runs)))
    assert of_candidate["all", "a"]["none"] == pytest.approx((0.0, 0.0))
    assert of_candidate["all", "b"]["none"] == pytest.approx((0.1, 0.0))


def test_settings_that_a_stage_has_dropped_can_be_left_out(capsys):
    chosen = ["--tasks", "PokeCube-v1", "--seeds", "120"]
    assert main(chosen) == 0
    assert "`noise_bound=1.0 utd=0.5`" in capsys.readouterr().out
    assert main([*chosen, "--without", "utd", "noise_bound"]) == 0
    rows = capsys.readouterr().out
    assert "`penalty=30.0`" in rows
    assert "utd" not in rows
    assert "noise_bound" not in rows
