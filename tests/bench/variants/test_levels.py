import pytest

from symsteer.bench.audit.result import AuditSettings
from symsteer.bench.audit.study import cells
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.tasks import make
from symsteer.bench.variants.levels import LEVELS, points_of, strength, with_numbers
from symsteer.errors import UserError
from symsteer.registry import allow
from tools.pages.audit import SUMMARY, levels, read_summary

PLACE = ("PushCube-v1", "floating")


def audit_of(task="Task-v1", group="C8", **defects):
    """Rows of a summary; 0 is the unbroken world."""
    return [
        {
            "task": task,
            "embodiment": "floating",
            "variant": f"wind:{number}" if number else "none",
            "group": group,
            "decision": [value, 0.0, 1.0],
        }
        for number, value in ((float(k.removeprefix("s")) / 100, v) for k, v in defects.items())
    ]


def test_a_level_is_where_the_audit_first_finds_its_defect():
    rows = audit_of(s0=0.02, s25=0.12, s50=0.22, s100=0.5) + audit_of(group="D4", s0=0.0, s100=0.9)
    audited = points_of(rows)
    strengths = {level: strength("wind", level, "Task-v1", "floating", audited) for level in LEVELS}
    # 0.02 + 0.1 s / 0.25 = 0.1; 0.22 + 0.28 (s - 0.5) / 0.5 = 0.25; the last point is 0.5.
    assert strengths == {"easy": 0.2, "medium": 0.55, "hard": 1.0}
    audited = points_of(audit_of(s0=0.0, s25=0.3, s50=0.1, s100=0.3))
    assert strength("wind", "medium", "Task-v1", "floating", audited) == 0.21


def test_levels_become_numbers_wherever_a_strength_can_stand():
    text = "wind:easy..0.9@0.5+action_gain:medium+obstacle:1"
    wind, gain = (
        strength(*level, *PLACE) for level in (("wind", "easy"), ("action_gain", "medium"))
    )
    assert with_numbers(text, *PLACE) == f"wind:{wind:g}..0.9@0.5+action_gain:{gain:g}+obstacle:1"
    for other in ("none", "wind", "wind:0.3", "easy", "package.easy:Wind:0.5"):
        assert with_numbers(other, *PLACE) == other


def test_runs_audits_and_environments_take_levels():
    config = RunConfig(task=PLACE[0], variant="perception_bias:medium")
    number = strength("perception_bias", "medium", *PLACE)
    assert config.variant == f"perception_bias:{number:g}"
    assert config == RunConfig(task=PLACE[0], variant=config.variant)
    env = make(PLACE[0], num_envs=1, variant="perception_bias:medium")
    assert [part.strength for part in env.variants] == pytest.approx([number])
    env.close()
    (settings,) = cells([PLACE[0]], ["perception_bias:medium"], AuditSettings())
    assert settings.variant == config.variant


@pytest.mark.parametrize(
    ("task", "embodiment", "variant", "words"),
    [
        (
            "PushCube-v1",
            "floating",
            "wind:hard",
            "the largest that was audited is 0.30",
        ),
        ("PushCube-v1", "panda", "wind:easy", "unbroken it is 0.31; take a higher level"),
        ("package:Task", "floating", "wind:easy", "needs an audit of 'wind' for 'package:Task'"),
        ("PushCube-v1", "floating", "gust:easy", "needs an audit of 'gust'"),
        ("PushCube-v1", "floating", "wind:esay", "no strength can be read for 'wind'"),
    ],
)
def test_levels_that_do_not_exist(task, embodiment, variant, words):
    allow(task)
    with pytest.raises(UserError, match=words):
        RunConfig(task=task, embodiment=embodiment, variant=variant)


def test_the_page_has_the_levels_of_the_committed_audit():
    page = (SUMMARY.parents[3] / "docs" / "variants.md").read_text()
    assert levels(read_summary(SUMMARY)).strip() in page
