"""``symsteer new``: the file of a new agent, with its test."""

from __future__ import annotations

import keyword
import re
from pathlib import Path
from string import Template
from typing import Annotated, Literal

import tyro

from symsteer.errors import UserError
from symsteer.files import write_together
from symsteer.terminal import to_paste

TEMPLATES = Path(__file__).resolve().parent / "templates"

ORIGINS = {
    "equivariant": ("EquivariantAgent", "the equivariant agent"),
    "standard": ("StandardAgent", "the standard agent"),
}
"""Class and description of the agents that a new one can begin as."""

SYMMETRY = {
    "diagnostics": ", actor_equivariance_error",
    "Group": "Group, ",
    "symmetry": """def test_it_turns_with_the_world():
    agent, obs = trained()
    assert actor_equivariance_error(agent, obs, Group.parse("C8")) < 1e-5


""",
}
"""What the tests of equivariant agents alone have."""


def new(
    kind: Annotated[Literal["agent"], tyro.conf.Positional],
    name: Annotated[str, tyro.conf.Positional],
    like: Literal["equivariant", "standard"] = "equivariant",
    out: Path = Path(),
) -> int:
    """Write a file with a new agent and a file with its tests.

    Args:
        kind: What to write.
        name: Of the agent, for instance my-agent: the file is my_agent.py, the class MyAgent.
        like: The agent that it begins as.
        out: Folder for both files.
    """
    from symsteer.agents import AGENTS

    if not re.fullmatch(r"[a-z][a-z0-9]*([_-][a-z0-9]+)*", name) or keyword.iskeyword(name):
        raise UserError(
            f"{name!r} cannot be the name of an agent: use small letters, digits and hyphens, "
            "e.g. my-agent"
        )
    if name in AGENTS:
        raise UserError(f"there is an agent {name!r} already; choose another name")
    module = name.replace("-", "_")
    title = "".join(word.capitalize() for word in module.split("_"))
    origin, summary = ORIGINS[like]
    values = {
        **{"name": name, "module": module, "file": f"test_{module}.py"},
        "Class": title if title.endswith("Agent") else f"{title}Agent",
        "imports": ", ".join(sorted(["Batch", "SacOptions", origin])),
        **{"Origin": origin, "summary": summary, "Summary": summary.capitalize()},
        **(SYMMETRY if like == "equivariant" else dict.fromkeys(SYMMETRY, "")),
    }
    templates = {out / f"{module}.py": "agent.txt", out / f"test_{module}.py": "test.txt"}
    for path in templates:
        if path.exists():
            raise UserError(f"{path} is there already; choose another name, or a folder with --out")
    write_together(
        {
            path: Template((TEMPLATES / template).read_text()).substitute(values).encode()
            for path, template in templates.items()
        }
    )
    where = "" if out == Path() else f"{to_paste('cd', out)}\n"
    target = f"{module}:{values['Class']}"
    print(
        f"wrote {' and '.join(map(str, templates))}\n\n"
        f"{where}python -m pytest test_{module}.py\n"
        f"{to_paste('symsteer', 'run', '--agent', target, '--env-steps', 10000)}\n"
        "symsteer site runs   # its page: site/index.html\n\n"
        "docs/submit.md: what an agent can override, how to compare it with others and submit it"
    )
    return 0
