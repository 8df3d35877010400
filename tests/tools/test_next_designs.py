"""The table of the next designs: the verdict of the suite dial on its own agent; missing runs."""

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.runs import load_runs
from symsteer.leaderboard.text import SPACE
from tools.pages import next_designs


@pytest.mark.long
def test_the_safe_agent_of_the_suite_dial_is_judged_as_on_its_page(monkeypatch):
    """Its page has .020 and .048, and .187 and .137 of the best of the others."""
    runs = load_runs([next_designs.RECORDS[0]], area_from=next_designs.STUDY.area_from)
    with pytest.raises(UserError, match="slow lacks 108 runs; finish the suite dial-next"):
        next_designs.render(runs)
    monkeypatch.setattr(next_designs, "DESIGNS", ())
    rows = next_designs.render(runs).replace(SPACE, " ").splitlines()[2:]
    cells = [[cell.strip() for cell in row.split("|")[1:-1]] for row in rows]
    success, area, *elsewhere = cells
    assert success[:3] == ["`residual-pathway`", "10", "success"]
    assert success[5:] == ["0.020", "0.187", "yes"]
    assert area[5:] == ["0.048", "0.137", "no"]
    assert [row[1] for row in elsewhere] == ["9", "9"]
