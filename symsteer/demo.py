"""``symsteer demo``: one result of the leaderboard, made anew in minutes on a CPU."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from symsteer.errors import UserError
from symsteer.files import write_together
from symsteer.leaderboard import paths
from symsteer.terminal import BOARD, to_paste

if TYPE_CHECKING:
    from symsteer.bench.runs.config import RunConfig


def demo(runs: Path = Path("runs/demo")) -> int:
    """See `standard` and `equivariant` in a world that breaks the symmetry: minutes on a CPU.

    They steer a base policy that comes with SymSteer.

    Args:
        runs: Folder of the runs and of their leaderboard.
    """
    from symsteer.bench.cli import Workforce, sweep
    from symsteer.bench.sweep.suite import load_suite
    from symsteer.leaderboard.command import report
    from symsteer.leaderboard.curves import curves_as_text

    copy_base(load_suite("demo").runs[0], runs)
    exit_code = sweep("demo", runs=runs, workforce=Workforce(together=5))
    report((runs,), out=runs / "leaderboard")
    print(f"\n{curves_as_text((runs,))}")
    print(
        "\nOne motor is weak. This breaks the symmetry, but a symmetric agent sees what it did and"
        "\ncan correct it. Other breaks cost symmetric agents success: in the repository the page"
        "\nleaderboard/LEADERBOARD.md compares many worlds, each with several base policies.\n"
        f"\nOpen the leaderboard:  {runs / 'leaderboard' / 'LEADERBOARD.md'}"
        f"\nSee the runs:          {to_paste(_script('tensorboard'), '--logdir', runs)}"
        f"  then {BOARD}"
    )
    return exit_code


def copy_base(run: RunConfig, out: Path) -> None:
    """Copy the base policy of a run, which comes with SymSteer, and its demonstrations to OUT/base.

    Raises:
        UserError: if this copy of SymSteer lacks them, or they cannot be written.
    """
    from symsteer.bench.runs.base_policy import demonstration_path, find_base

    if (folder := find_base(run, paths.RESULTS)) is None:
        raise UserError(f"{paths.RESULTS / 'base'} lacks the base policy; install SymSteer again")
    demos = demonstration_path(run, paths.RESULTS)
    files = [demos, demos.with_suffix(".json"), *folder.iterdir()]
    write_together({out / file.relative_to(paths.RESULTS): file.read_bytes() for file in files})


def _script(name: str) -> str:
    """How to call a console script of this environment from the current folder."""
    path = Path(sys.executable).with_name(name)
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return name
