"""``symsteer demo``: one result of the leaderboard, made anew in minutes on a CPU."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from symsteer.errors import UserError
from symsteer.terminal import BOARD, to_paste

if TYPE_CHECKING:
    from symsteer.bench.runs.config import RunConfig

TOGETHER = 5
"""Runs that share a process: all of an agent."""


def demo(out: Path = Path("runs/demo")) -> int:
    """See in a world that breaks it whether symmetry is worth keeping: minutes on a CPU.

    A plain and an equivariant agent steer a base policy that comes with SymSteer.

    Args:
        out: Folder of the runs and of their leaderboard.
    """
    from symsteer.bench.cli import Workforce, sweep
    from symsteer.bench.sweep.suite import load_suite
    from symsteer.leaderboard.command import report
    from symsteer.leaderboard.curves import curves_as_text

    copy_base(load_suite("demo").runs[0], out)
    exit_code = sweep("demo", out=out, workforce=Workforce(together=TOGETHER))
    report((out,), out=out / "leaderboard")
    print(f"\n{curves_as_text((out,))}")
    print(
        "\nThe motors drift to one side, which no symmetric agent can undo. In a symmetric world"
        "\nsymmetry gains: leaderboard/LEADERBOARD.md in the repository compares many worlds, and"
        "\nmore than this one base policy.\n"
        f"\nOpen the leaderboard:  {out / 'leaderboard' / 'LEADERBOARD.md'}"
        f"\nSee the runs:          {to_paste(_script('tensorboard'), '--logdir', out)}"
        f"  then {BOARD}"
    )
    return exit_code


def copy_base(run: RunConfig, out: Path) -> None:
    """Copy the base policy of a run, which comes with SymSteer, and its demonstrations to OUT/base.

    Raises:
        UserError: if this copy of SymSteer lacks them, or they cannot be written.
    """
    from symsteer.files import write_together
    from symsteer.leaderboard.paths import RESULTS

    files = {out / file.relative_to(RESULTS): file.read_bytes() for file in base_files(run)}
    write_together(files)


def base_files(run: RunConfig) -> list[Path]:
    """The files of a base policy that comes with SymSteer, and of its demonstrations.

    Raises:
        UserError: if this copy of SymSteer lacks them.
    """
    from symsteer.bench.runs.base_policy import demonstration_path, find_base
    from symsteer.leaderboard.paths import RESULTS

    folder = find_base(run, RESULTS)
    if folder is None:
        raise UserError(
            f"{RESULTS / 'base'} lacks the base policy of the demo; install SymSteer again"
        )
    demonstrations = demonstration_path(run, RESULTS)
    return [demonstrations, demonstrations.with_suffix(".json"), *folder.iterdir()]


def _script(name: str) -> str:
    """How to call a console script of this environment from the current folder."""
    path = Path(sys.executable).with_name(name)
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return name
