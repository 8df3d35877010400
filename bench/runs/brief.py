"""``symsteer run --help``: the options that most runs need.

They are read from the source of the configuration. To import it would import torch, which takes
seconds. ``--help all`` imports it, and shows every option.
"""

from __future__ import annotations

import ast
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path

from symsteer.terminal import folded

ALL = ("--help", "all")

PREFIXES = {
    "RunConfig": "",
    "DemonstrationConfig": "demonstrations.",
    "EvaluationConfig": "evaluation.",
    "Execution": "",
}
"""What the options of each dataclass begin with."""

COMMON = (
    *("task", "embodiment", "variant", "agent", "seed", "env-steps", "num-envs", "sim", "device"),
    *("policy.name", "demonstrations.count", "evaluation.every", "evaluation.final-episodes"),
    *("runs", "base-policy", "sim-workers", "track", "quiet"),
)

END = """
symsteer list                           the names of tasks, variants, agents and base policies
symsteer run --help all                 all options
symsteer run --agent NAME --help all    with the options of this agent, --agent.X"""


def wants_brief(arguments: Sequence[str]) -> bool:
    """Whether the arguments ask for help, but not for all of it."""
    asks = any(word in ("-h", "--help") for word in arguments)
    return asks and not any(pair == ALL for pair in itertools.pairwise(arguments))


def brief() -> str:
    """The text, folded to the width of the terminal."""
    options = {option: text for option, *text in _options()}
    lines = ["usage: symsteer run [OPTIONS]", ""]
    lines += ["Steer a base policy with one agent on one task, and record the results.", ""]
    for name in COMMON:
        default, text = options[name]
        shown = "" if default in ("None", "False") else f" (default: {default})"
        lines.append(folded(f"  --{name:26s}", f"{text}{shown}"))
    return "\n".join([*lines, END])


def _options() -> Iterator[tuple[str, str, str]]:
    """Name, default and explanation of the options of all runs."""
    tree = ast.parse(Path(__file__).with_name("config.py").read_bytes())
    for kind in (node for node in tree.body if isinstance(node, ast.ClassDef)):
        body = kind.body if kind.name in PREFIXES else []
        for field, following in itertools.pairwise(body):
            match field, following:
                case (
                    ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value),
                    ast.Expr(value=ast.Constant(value=str(text))),
                ):
                    name = "policy.name" if name == "policy_name" else name.replace("_", "-")
                    while isinstance(value, ast.Call):  # Path("runs")
                        value = value.args[0]
                    default = getattr(value, "value", ast.unparse(value))
                    yield PREFIXES[kind.name] + name, str(default), " ".join(text.split())
