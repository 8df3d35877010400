"""Seeds of episodes: apart from one another, and repeatable."""

from symsteer.bench.steering.seeds import (
    FIRST_TRAINING_SEED,
    HELD_OUT_SEED,
    diagnostic_seeds,
    held_out_seeds,
    steerability_seeds,
    training_seeds,
)


def test_training_seeds_are_apart_from_all_others_and_repeat():
    first, second = training_seeds(3, 0, 100), training_seeds(3, 1, 100)
    assert first == training_seeds(3, 0, 100)
    assert len({*first, *second, *training_seeds(4, 0, 100)}) == 300
    assert min(first) >= FIRST_TRAINING_SEED
    assert max(first) < 2**31


def test_no_kind_of_episode_shares_seeds_with_another():
    assert held_out_seeds(2) == [HELD_OUT_SEED, HELD_OUT_SEED + 1]
    kinds = [held_out_seeds(10_000), diagnostic_seeds(10_000)]
    kinds += [[s for policy in (0, 1, 2**32 - 1) for s in steerability_seeds(policy, 100)]]
    kinds += [training_seeds(0, 0, 10_000)]
    assert len({seed for kind in kinds for seed in set(kind)}) == sum(len(set(k)) for k in kinds)
