"""How long a page of 1,000 runs takes to load: python -m tests.leaderboard.site.thousand_runs

From the request to the table that can be sorted and filtered, in headless Chromium, from disk.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from pathlib import Path

from symsteer.leaderboard.records import write_record
from symsteer.leaderboard.site.build import generate
from symsteer.leaderboard.study import PAPER
from tests.leaderboard.record_factory import make_cell
from tests.leaderboard.site.browser import Visit, chromium, opened

AGENTS = ("base", "zero", "standard", "augmented", "equivariant")
VARIANTS = ("none", "action_gain:0.5", "action_gain:1", "wind:1", "obstacle:1")
REPEATS = 7


def write_runs(folder: Path) -> int:
    """Records of 1,000 runs; returns their number."""
    number = 0
    for task in ("PickCube-v1", "PushCube-v1"):
        for embodiment in ("floating", "panda"):
            for variant in VARIANTS:
                place = {"task": task, "embodiment": embodiment, "variant": variant}
                for record in make_cell(dict.fromkeys(AGENTS, 0.5), seeds=10, **place):
                    number += 1
                    write_record(record, folder / str(number) / "record.json")
    return number


def main() -> int:
    """Print the median and the longest time; returns the exit code."""
    if chromium() is None:
        print("there is no Chromium on the PATH", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        number = write_runs(folder / "runs")
        started = time.perf_counter()
        generate([folder / "runs"], folder / "site", PAPER, docs=False)
        print(f"{number} records: site written in {time.perf_counter() - started:.1f} s")
        page = folder / "site" / "runs.html"
        print(f"runs.html: {page.stat().st_size / 2**20:.2f} MiB")
        seconds = []
        with opened() as browser:
            for _ in range(REPEATS):
                context = browser.new_context()
                started = time.perf_counter()
                visit = Visit(context, page)
                seconds.append(time.perf_counter() - started)
                assert not visit.troubles, visit.troubles
                assert f"of {number:,} entries" in visit.page.inner_text(".dt-info")
                context.close()
    print(
        f"loaded in {statistics.median(seconds):.2f} s (median of {REPEATS}, longest "
        f"{max(seconds):.2f} s)"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
