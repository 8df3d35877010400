"""`symsteer site`: results and documentation as a folder of static pages."""

from __future__ import annotations

from pathlib import Path

import tyro

from symsteer.leaderboard.paths import STUDY, chosen_records
from symsteer.terminal import printable


def site(
    records: tyro.conf.Positional[tuple[Path, ...]] = (),
    out: Path = Path("site"),
    study: str | None = None,
    audit: Path | None = None,
    reproductions: Path | None = None,
    docs: bool = True,
) -> int:
    """Write results and documentation as a folder of static pages (docs/site.md).

    Args:
        records: Record files, run folders or folders of runs; default: the committed records.
        out: Folder of the site: a new one, or that of an earlier site, which is replaced.
        study: The claims to test: name of a study in leaderboard/studies or path of a .toml file;
            default: those of the paper, for the committed records those of their study.
        audit: The folder that `symsteer audit --out` wrote, for its numbers and maps, or its
            summary.json; default: the committed numbers.
        reproductions: The folder that `symsteer reproduce --into` wrote to: its runs are marked;
            default: for committed records the committed one.
        docs: Build the documentation, too, in a checkout of the repository.

    Returns:
        0.

    Raises:
        UserError: for paths that cannot be read or written, records that are not valid, and
            packages that are not installed.
    """
    paths = chosen_records(records, "site")
    # Here, so that the help of all commands does not wait for matplotlib and scipy.
    from symsteer.leaderboard.site.build import generate
    from symsteer.leaderboard.study import PAPER

    study = study or (PAPER if records else STUDY)
    results = generate(paths, out, study, audit, docs, reproductions)
    index = out.resolve() / "index.html"
    print(printable(f"wrote {index}: the pages of {len(results.runs)} records"))
    if docs and not results.docs.is_built:
        print("without the documentation, which only a checkout of the repository has")
    return 0
