"""The demo with other seeds: does its table show what the leaderboard shows?

python -m tools.demo_sets runs/demo-sets

Set k is the suite ``demo`` on the same base policy, with seeds that are 100 k higher. A set shows
the effect if its sentence has `equivariant` above `standard`; it is counted, too, in how many this
is clear. The same command continues after a stop; a set takes as long as the demo.
"""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import replace
from pathlib import Path

from symsteer.bench.sweep.command import run_plan
from symsteer.bench.sweep.plan import make_plan
from symsteer.bench.sweep.suite import Suite, load_suite
from symsteer.bench.sweep.workforce import Workforce
from symsteer.demo import copy_base
from symsteer.errors import UserError
from symsteer.leaderboard.curves import curves_as_text
from symsteer.terminal import complain


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("out", type=Path, help="folder of the runs, with a folder for each set")
    parser.add_argument("--sets", type=int, default=10, help="number of sets of seeds")
    parser.add_argument("--workers", type=int, default=0, help="as of `symsteer sweep`")
    args = parser.parse_args()
    suite, shown, clear = load_suite("demo"), 0, 0
    try:
        for number in range(1, args.sets + 1):
            out = args.out / str(number)
            # The seeds of the base policy and of its demonstrations stay.
            runs = tuple(replace(run, seed=run.seed + 100 * number) for run in suite.runs)
            copy_base(runs[0], out)
            run_plan(
                make_plan(Suite(suite.name, "", runs), out), Workforce(args.workers, together=5)
            )
            table = curves_as_text([out])
            clear += "equivariant is clearly above standard" in table
            shown += bool(re.search("equivariant is (not )?clearly above standard", table))
            print(f"\nset {number}: {table}\n", flush=True)
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    print(f"the effect is shown by {shown} of {args.sets} sets, clearly by {clear}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
