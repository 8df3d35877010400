"""The registry of policies: names, mistakes, and that reading names costs no import of torch."""

import subprocess
import sys

import pytest

from symsteer.errors import UserError
from symsteer.policies import POLICIES


def test_names_and_summaries_without_torch():
    code = (
        "import sys; from symsteer.policies import POLICIES; "
        "print([POLICIES.summary(n) != '' for n in POLICIES], 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("True] False")


@pytest.mark.parametrize("name", POLICIES.names())
def test_every_policy_is_named_as_it_is_registered(name):
    kind = POLICIES.get(name)
    assert kind.name == POLICIES.name_of(kind) == name
    assert kind.Options.from_json(kind.Options().to_json()) == kind.Options()


def test_an_unknown_name_suggests_the_nearest():
    with pytest.raises(UserError, match="did you mean 'plain'"):
        POLICIES.get("plane")
