"""The variance of the training gradient, which `python -m tools.gradient_variance` measures."""

from __future__ import annotations

import pytest

from symsteer.errors import UserError
from tools import gradient_variance


def test_the_variance_is_measured_on_the_same_batches(world):
    layouts = world.obs_layout, world.act_layout
    fields = {"steps": 3, "batch_size": 16}
    found = {
        deviation: gradient_variance.measure(
            "edp",
            world.options(observation_noise=deviation, **fields),
            world.episodes(2),
            layouts,
            0,
            60,
        )
        for deviation in (1e-3, 4.0)
    }
    # Precise observations leave each pair its own target.
    assert found[1e-3]["orbit"] == found[1e-3]["own"] > 0
    assert found[1e-3]["difference"] is None
    assert 0 < found[4.0]["orbit"] < found[4.0]["own"]
    assert 0.3 < found[4.0]["difference"] < 3
    with pytest.raises(UserError, match="need a group"):
        gradient_variance.measure(
            "plain", world.options("plain", observation_noise=1.0), world.episodes(1), layouts, 0, 2
        )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--seeds", "0"], "seeds and steps must be at least 1, and batches at least 2"),
        (["--task", "PikCube-v1"], "did you mean 'PickCube-v1'"),
        (["--policies", "ed"], "did you mean 'edp'"),
    ],
)
def test_mistakes_in_measuring_the_variance(arguments, words, capsys):
    assert gradient_variance.main([*arguments, "--demonstrations", "1"]) == 2
    assert words in capsys.readouterr().err
