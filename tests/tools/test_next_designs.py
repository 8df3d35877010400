"""The table of the next designs: the verdict of the suite dial on its own agent; missing runs."""

import re

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.paths import PAGE_FOLDER
from symsteer.leaderboard.runs import load_runs
from symsteer.leaderboard.text import SPACE
from tools.pages import next_designs


@pytest.mark.long
def test_the_safe_agent_of_the_suite_dial_is_judged_as_on_its_page(monkeypatch):
    """Its losses and those of the best of the others are the page's, with the same verdicts."""
    page = (PAGE_FOLDER / "dial" / "LEADERBOARD.md").read_text()
    line = next(line for line in page.splitlines() if "above an agent without regret by" in line)
    of_success, of_area = re.findall(r"\+([\d.]+) of \w+ \(`\S+`, the best of the others: ", line)
    others_success, others_area = re.findall(r"the best of the others: \+([\d.]+)\)", line)
    runs = load_runs([next_designs.RECORDS[0]], area_from=next_designs.STUDY.area_from)
    with pytest.raises(UserError, match="slow lacks 108 runs; finish the suite dial-next"):
        next_designs.render(runs)
    monkeypatch.setattr(next_designs, "DESIGNS", ())
    rows = next_designs.render(runs).replace(SPACE, " ").splitlines()[2:]
    cells = [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows]
    success, area, *elsewhere = cells
    assert success[:3] == ["`residual-pathway`", "10", "success"]
    assert success[5:] == [of_success, others_success, "yes"]
    assert area[5:] == [of_area, others_area, "no"]
    assert [row[1] for row in elsewhere] == ["9", "9"]
