"""The page and its figures on a realistic set of records: what it says, and in which words."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from symsteer.leaderboard.findings import analyse
from symsteer.leaderboard.page import render_page
from symsteer.leaderboard.records import Evaluation, RunRecord, write_record
from symsteer.leaderboard.report import generate
from symsteer.leaderboard.study import FOLDER, PAPER, read_study
from symsteer.leaderboard.summary import Run, summarize
from symsteer.leaderboard.text import NOTHING
from tests.leaderboard.record_factory import diverging, make_cell, make_evaluation, make_record

DEFECTS = {"none": 0.002, "wind:0.25": 0.1, "wind:0.5": 0.2, "wind:1": 0.4}
HOSTILE = "x`</td><img src=x onerror=alert(1)>`|$a$\n# H [l](javascript:alert(1))"


def audit(folder: Path, group: str = "C8", variants: dict[str, float] = DEFECTS) -> Path:
    """A summary as `symsteer audit --out` writes it."""
    rows = [
        {
            "task": "PickCube-v1",
            "embodiment": "floating",
            "variant": variant,
            "group": group,
            "version": 2,
            "part": "object" if variant == "none" else "tool",
            "decision": [defect, 0.9 * defect, 1.1 * defect],
            "resets": [0.0, -0.001, 0.001],
            "resets_p": 0.5,
        }
        for variant, defect in variants.items()
    ]
    path = folder / "summary.json"
    path.write_text(json.dumps(rows))
    return path


def write(folder: Path, records: list[RunRecord]) -> None:
    for index, record in enumerate(records):
        write_record(record, folder / "results" / f"{index}.json")


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four audited cells and one that is not; strictness pays up to a defect of 0.3."""
    folder = tmp_path_factory.mktemp("board")
    records = []
    for variant, defect in (DEFECTS | {"wind:0.75": 0.3}).items():
        rates = {"base": 0.3, "zero": 0.4, "golden-ticket": 0.45, "standard": 0.5}
        rates |= {"standard-matched": 0.5, "equivariant": 0.8 - defect, "residual-pathway": 0.7}
        records += make_cell(rates, episodes=100, variant=variant)
    for record in records:
        if record.settings.agent == "golden-ticket":
            record.budget.env_steps = 12_800
    first = records[0]
    other = first.provenance.model_copy(
        update={"commit": "f" * 40, "device": "cuda", "processor": "One (model 2)"}
    )
    first.continued = [other]
    first.wall_clock.resumed = 1
    write(folder, records)
    generate([folder / "results"], folder, audit(folder))
    return folder


def page_of(records: list[RunRecord], study: str = PAPER) -> str:
    """The page without figures and links."""
    runs = [Run(Path(f"{i}.json"), record) for i, record in enumerate(records)]
    summary = summarize(runs)
    return render_page(
        summary, analyse(summary, {}, read_study(study)), {}, {run.path: None for run in runs}
    )


def text_of(board: Path) -> str:
    return (board / "LEADERBOARD.md").read_text().replace("\u00a0", " ")


def table_after(text: str, heading: str) -> list[list[str]]:
    """Cells of the first table after a line that starts with `heading`."""
    lines = text[text.index(f"\n{heading}") :].splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("|"))
    rows = []
    for line in lines[start:]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]])
    return rows


def tallies(text: str) -> dict[str, list[str]]:
    """The table of learners at a glance: against `standard` and the best reference, divergence."""
    _, _, *rows = table_after(text, "## At a glance")
    return {agent.strip("`"): [cell.replace("\u00a0", " ") for cell in row] for agent, *row in rows}


def test_the_main_table_ranks_with_ties_and_never_references(board: Path) -> None:
    header, _, *rows = table_after(text_of(board), "### Unbroken symmetry")
    assert header == [
        "Rank",
        "Agent",
        "Success (final window)",
        "Last",
        "Against base",
        "AUC,<br>dip",
        "Steps to 80 %",
        "Seeds \u00d7 episodes",
    ]
    shown = {row[1]: row for row in rows}
    ranks = {agent: row[0] for agent, row in shown.items()}
    assert ranks == {
        "`base`": "\u2013",
        "`zero`": "\u2013",
        "`golden-ticket`<br>search 12.8 k": "\u2013",
        "`equivariant`": "1",
        "`residual-pathway`": "2",
        "`standard`": "3=",
        "`standard-matched`": "3=",
    }
    assert list(ranks) == [row[1] for row in rows]
    assert shown["`golden-ticket`<br>search 12.8 k"][6] == "\u2013"
    assert shown["`standard`"][6] == "> 50 k (0/5)"
    assert shown["`equivariant`"][6] == "0 (5/5)"
    assert re.fullmatch(r"0\.80<br>\[0\.\d\d, 0\.\d\d\]", shown["`equivariant`"][2])
    assert re.fullmatch(r"\+0\.50 \u25b2<br>\[\+0\.\d\d, \+0\.\d\d\]", shown["`equivariant`"][4])
    links = re.findall(r"\[(\d)\]\((results/\d+\.json)\)", shown["`equivariant`"][7])
    assert [seed for seed, _ in links] == list("01234")
    assert all((board / target).exists() for _, target in links)
    assert shown["`equivariant`"][7].startswith("5 \u00d7 100<br>")


def test_headings_tell_apart_budgets_and_demonstrations_of_one_break() -> None:
    few = {"mode": "diverse", "count": 5, "seed": 0}
    rates = {"base": 0.3, "standard": 0.5}
    records = make_cell(rates) + make_cell(rates, demonstrations=few)
    records += make_cell(rates, variant="wind:1") + make_cell(
        rates, variant="wind:1", env_steps=100_000
    )
    headings = re.findall(r"^### (.*)$", page_of(records).replace("\u00a0", " "), re.MULTILINE)
    assert headings[-4:] == [
        "Unbroken symmetry, 5 demonstrations",
        "Unbroken symmetry, 50 demonstrations",
        "Broken by `wind:1`, 50 k steps",
        "Broken by `wind:1`, 100 k steps",
    ]


def test_agents_that_a_cell_does_not_have_are_named_below_its_table() -> None:
    records = make_cell({"base": 0.3, "standard": 0.5, "equivariant": 0.5})
    records += make_cell({"base": 0.3, "standard": 0.5}, variant="wind:1")
    text = page_of(records)
    assert "Not ranked" not in text
    assert text.count("Not run here: `equivariant`.") == 1
    _, _, *rows = table_after(text, "### Broken by")
    assert [row[0] for row in rows] == ["`base`", "`standard`"]
    (few,) = make_cell({"equivariant": 0.5}, seeds=1, variant="wind:1")
    text = page_of([*records, few])
    assert "Not every agent here has the 5 finished seeds" in text
    assert "1\u00a0finished, 4\u00a0missing" in text


def test_learners_are_held_against_the_best_reference(board: Path) -> None:
    text = text_of(board)
    assert "Best reference: `golden-ticket`, 0.45. Against it: `equivariant` +0.35 [" in text
    assert tallies(text)["residual-pathway"] == ["5 ▲ 0 ▼ of 5", "5 ▲ 0 ▼ of 5", "0/25"]


def test_the_best_reference_counts_where_five_runs_steer_its_policy() -> None:
    records = make_cell({"base": 0.25, "standard": 0.75})
    text = page_of(records)
    assert tallies(text) == {"standard": ["1 ▲ 0 ▼ of 1", "0/5"]}
    records[-1].base_policy.content_hash = "f" * 64
    assert "## At a glance" not in page_of(records)


def test_the_glance_counts_diverged_runs_of_all_worlds() -> None:
    records = diverging("standard", [1]) + diverging("standard", [0, 3], variant="wind:1")
    records += diverging("equivariant", []) + diverging("equivariant", [], variant="wind:1")
    found = tallies(page_of(records))
    # There is no reference, and no column for it.
    assert found == {"standard": [NOTHING, "3/10"], "equivariant": ["0 ▲ 0 ▼ of 2", "0/10"]}


def test_a_claim_of_no_effect_says_so_wherever_it_is_named() -> None:
    """Its name alone would say the opposite of its verdict."""
    text = page_of(diverging("standard", range(5)) + diverging("augmented", []), "stress")
    name = "Rotated data prevent value divergence (predicted: no effect)"
    assert f"- **Contradicted** (1): {name}." in text
    assert f"| {name} (divergence under stress) |" in text
    assert "Symmetry prevents value divergence (predicted" not in text


def test_the_second_table_shows_q_and_cost(board: Path) -> None:
    text = text_of(board)
    header, _, *rows = table_after(text, "Q-values, symmetry and cost")
    bounds = "(feasible Q: \u221220 to 0)"
    assert header[:3] == [
        "Agent",
        "Q diverged",
        f"\\|Q\\| over the largest feasible, overshoot {bounds}",
    ]
    assert [row[-1] for row in rows] == ["4.2"] * 4
    assert [row[1:3] for row in rows] == [["0/5", "0.5<br>\u2013"]] * 4
    # Nobody measured it.
    assert "TD error" not in header


def test_the_page_says_how_symmetric_the_base_policies_are() -> None:
    records = make_cell({"base": 0.3, "standard": 0.5}, episodes=20)
    said = "Equivariance error of its actions: "
    assert f"{said}2.0e-7." in page_of(records).replace("\u2212", "-")
    for number, record in enumerate(records):
        record.base_policy.content_hash = f"{number:064x}"
        record.base_policy.equivariance_error = 2e-7 if number else 0.5
    assert f"{said}2.0e-7 to 0.5." in page_of(records).replace("\u2212", "-")
    for record in records:
        record.base_policy.equivariance_error = None
    assert said not in page_of(records)


def test_every_claim_has_a_verdict(board: Path) -> None:
    text = text_of(board)
    header, _, *rows = table_after(text, "<summary>Claims")
    families = [re.search(r"\((\w+)\)$", row[0])[1] for row in rows]
    assert families == ["efficiency"] * 2 + ["limits"] * 3
    few = "**not tested**: base policies at several defects: 1, 5 are needed"
    supported = "**supported**, for one base policy alone"
    assert [row[-1] for row in rows] == [supported, supported, few, few, supported]
    shown = dict(zip(header, rows[-1], strict=True))
    assert shown["Effect"] == (
        "success, `residual-pathway` minus `equivariant`, broken cells of `floating` minus the "
        "same in unbroken cells"
    )
    # -0.1 in the unbroken cell; -0.1 + the defect in the broken ones, 0.25 on average.
    assert shown["Size, 95 % interval"].startswith("+0.250<br>[+0.")
    assert shown["Cells, pairs, policies"] == "5, 25, 1"
    assert shown["Smallest of interest"] == "0.05"
    assert shown["p: none; at least that"].endswith("<br>1.000")
    assert "declared in `paper.toml` (sha256 `" in text
    _, untested = text.split("\nNot tested:\n\n", 1)
    lines = (line[2:].split(": ", 1) for line in untested.split("\n\n")[0].splitlines())
    reasons = {reason: names.split("; ") for reason, names in lines}
    assert reasons["nobody diverged"][0] == "Symmetry prevents value divergence"
    assert reasons["not measured over all decisions"][0] == "Symmetry makes Q less wrong"
    assert reasons["no runs of `wrong-group` in unbroken cells"] == [
        "Control: a wrong group does not help"
    ]
    assert len(rows) + sum(map(len, reasons.values())) == len(read_study(PAPER).claims)


def test_the_papers_statements_have_their_tests_and_what_they_lack(board: Path) -> None:
    study = read_study(PAPER)
    text = (board / "PAPER.md").read_text().replace("\u00a0", " ")
    overall = {row[0]: row[1] for row in table_after(text, "What the paper says")[2:]}
    assert list(overall) == [statement.says for statement in study.statements]
    efficiency, divergence, *_ = study.statements
    assert overall[efficiency.says] == "2 supported, 1 not tested"
    assert overall[divergence.says] == "**not tested**"
    assert f"- {efficiency.says}: 2 supported, 1 not tested.\n" in text_of(board)
    for statement in study.statements:
        rows = table_after(text, f"### {statement.says}")[2:]
        assert [row[0] for row in rows] == list(statement.claims)
        claims = {row[0].rsplit(" (", 1)[0]: row for row in table_after(text_of(board), "They are")}
        for row in rows:
            if row[0] in claims:
                assert (row[2], row[4]) == (claims[row[0]][2], claims[row[0]][6])
            # Nothing here is undecided.
            assert row[5] == "\u2013"


def test_a_study_can_say_what_a_reader_must_know(tmp_path: Path) -> None:
    study = tmp_path / "mine.toml"
    said = ['notice = "> **Mind this.**"', 'details = "*Limits*: one."']
    study.write_text("\n".join([*said, 'declared = "abcdef0"', 'claims = "other.toml"']))
    (tmp_path / "other.toml").write_text((FOLDER / "paper.toml").read_text())
    records = make_cell({"base": 0.3, "standard": 0.5, "equivariant": 0.7})
    text = page_of(records, str(study))
    # There is no git here that could say that the commit is another one.
    assert "> **Mind this.**\n\n<details>" in text
    assert text.index("*Limits*: one.\n\n</details>") < text.index("## What symmetry gains")
    assert re.search(r"declared in `other.toml` \(sha256 `[0-9a-f]{12}`, commit `abcdef0`\)", text)
    assert "Mind this" not in page_of(records)


def spreads(records: list[RunRecord]) -> tuple[str, dict[str, list[str]]]:
    """The text and the table on the spread of runs, rows by agent."""
    text = page_of(records).replace("\u00a0", " ")
    section = text[text.index("How much is the base policy's") :]
    header, _, *rows = table_after(f"\n{section}", "Standard deviations")
    return section[: section.index("|")], {row[0]: row for row in [header, *rows]}


def test_the_page_says_how_much_of_the_spread_is_the_policys() -> None:
    rates = (0.1, 0.4, 0.5, 0.6, 0.9)

    def runs(of_policy: int, policies: int = 5) -> list[RunRecord]:
        records = []
        for policy, rate in enumerate(rates[:policies]):
            made = make_cell({"standard": rate}, seeds=of_policy, episodes=100, policy_seed=policy)
            for record in made:
                record.base_policy.content_hash = f"{policy}" * 64
            records += made
        return records

    text, found = spreads(runs(3))
    assert found["Agent"][1:] == [
        "Base policies",
        "Runs on one",
        "Episodes",
        "Base policies' share of the variance",
    ]
    policies, of_runs, episodes = map(float, found["`standard`"][1:4])
    # The episodes that succeed are others in every run, their number is not.
    assert (policies, of_runs) == (pytest.approx(np.std(rates, ddof=1), abs=0.01), 0)
    assert episodes == pytest.approx(0.04, abs=0.01)
    assert found["`standard`"][4] == "98 %"
    assert "one base policy" not in text
    text, found = spreads(runs(5, policies=1))
    assert found["Agent"][1:] == ["Runs on one", "Episodes"]
    assert "Each cell steers one base policy: intervals are about this policy alone" in text
    text, found = spreads(runs(1))
    assert found["Agent"][1:] == ["Both together", "Episodes"]
    assert "only the sum of both is known" in text


def test_the_map_names_slopes_parts_and_what_is_missing(board: Path) -> None:
    text = text_of(board)
    _, _, *rows = table_after(text, "<summary>The advantage of symmetry")
    by_agent = {(row[0], row[1]): row for row in rows}
    strict = by_agent["`equivariant`", "success"]
    assert strict[2:4] == ["`wind`", "1"]
    assert strict[4].startswith("\u22121.00<br>[\u22121.")
    # With one base policy no slope is marked as a finding.
    assert "\u25bc" not in strict[4]
    assert strict[5:] == ["\u2013", "base policies at several defects: 1, 5 are needed"]
    assert "Not audited, so not in the map: `PickCube-v1` `floating` `wind:0.75`." in text
    assert (
        "`symsteer audit --task PickCube-v1 --embodiment floating --group C8 "
        "--variant wind:0.75 --out runs/audit`" in text
    )
    _, _, *cells = table_after(text, "<summary>The map's numbers")
    sizes = [cell[1].split("<br>") for cell in cells]
    assert [size[0] for size in sizes] == ["0.002", "0.100", "0.200", "0.400"]
    assert [size[2] for size in sizes] == ["object", "tool", "tool", "tool"]


def test_provenance_names_every_session(board: Path) -> None:
    text = text_of(board)
    assert "1 of them continued after an interruption" in text
    assert "- Commits: `0123456789ab`, `ffffffffffff`" in text
    assert "- Devices: `cpu`, `cuda`" in text
    assert "- Processors: `One (model 2)`" in text
    assert "symsteer report" in text


def test_all_figures_are_there(board: Path) -> None:
    names = sorted(path.name for path in (board / "figures").iterdir())
    assert names[:2] == ["answer.svg", "improvement.svg"]
    assert re.fullmatch(r"map-floating-[0-9a-f]{6}\.svg", names[2])
    assert "profiles.svg" in names
    for name in names:
        root = ElementTree.fromstring((board / "figures" / name).read_bytes())
        assert f"](figures/{name})" in text_of(board)
        # No text elements: outlines look the same everywhere.
        assert not root.findall(".//{http://www.w3.org/2000/svg}text")


def test_the_csv_holds_both_comparisons(board: Path) -> None:
    with open(board / "leaderboard.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    row = next(r for r in rows if r["agent"] == "equivariant" and r["variant"] == "none")
    assert row["best_reference"] == "golden-ticket"
    assert float(row["against_best"]) == pytest.approx(0.35)
    assert float(row["against_base"]) == pytest.approx(0.5)
    # Three evaluations, none in the fourth fifth.
    assert row["rise"] == ""
    assert row["devices"] == "cpu"
    ticket = next(r for r in rows if r["agent"] == "golden-ticket")
    assert (ticket["search_steps"], ticket["auc"]) == ("12800", "")


def test_cells_with_too_few_seeds_are_not_counted_as_wins(tmp_path: Path) -> None:
    records = make_cell({"base": 0.3, "standard": 0.1, "equivariant": 0.9}, seeds=5)
    few = {"base": 0.3, "standard": 0.9, "equivariant": 0.1}
    records += make_cell(few, seeds=4, variant="wind:1")
    write(tmp_path, records)
    generate([tmp_path / "results"], tmp_path, audit(tmp_path))
    assert tallies(text_of(tmp_path)) == {
        "standard": [NOTHING, "0 ▲ 1 ▼ of 1", "0/9"],
        "equivariant": ["1 ▲ 0 ▼ of 1", "1 ▲ 0 ▼ of 1", "0/9"],
    }


@pytest.mark.long
def test_the_audit_changes_the_page_and_the_order_of_records_does_not(
    board: Path, tmp_path: Path
) -> None:
    again, other = tmp_path / "again", tmp_path / "other"
    few = [board / "results" / f"{index}.json" for index in range(35)]
    files = generate(few, again, audit(tmp_path, variants={"none": 0.1}))
    generate(few[::-1], other, audit(tmp_path, variants={"none": 0.1}))
    for path in files:
        assert path.read_bytes() == (other / path.relative_to(again)).read_bytes()
    assert "no base policy was steered at two defects" in text_of(again)
    assert len(list((again / "figures").glob("map-*.svg"))) == 1
    generate(few, again, audit(tmp_path, group="D4"))
    assert "There is no map yet" in text_of(again)
    assert not list((again / "figures").glob("map*"))


def test_numbers_that_are_not_finite_are_told_below_their_table(tmp_path: Path) -> None:
    """Returns of a run, at its last evaluation; Q has its own mark."""
    records = make_cell({"base": 0.3, "standard": 0.5})
    for record in records[-2:]:
        last = record.evaluations[-1].model_dump(by_alias=True)
        last["episodes"]["return"][3] = float("nan")
        last["diagnostics"]["q_bias"] = float("inf")
        record.evaluations[-1] = Evaluation.model_validate(last)
    told = f"return (first after {last['env_steps']} steps)"
    assert [record.not_finite for record in records] == [""] * (len(records) - 2) + [told] * 2
    write(tmp_path, records)
    generate([tmp_path / "results"], tmp_path, audit(tmp_path))
    page = (tmp_path / "LEADERBOARD.md").read_text()
    assert page.count(f": not finite: `{told}`") == 2


def test_hostile_names_stay_text_in_every_section(tmp_path: Path) -> None:
    """Finished runs of hostile agents in a hostile, audited cell: map, pairs, claims, notes."""
    markdown = pytest.importorskip("markdown_it")
    cell = {"base": 0.3, "standard": 0.5, "equivariant": 0.6, HOSTILE: 0.7, f"{HOSTILE}2": 0.4}
    records = make_cell(cell, task=HOSTILE, variant=HOSTILE, embodiment=HOSTILE)
    records += make_cell(cell, task=HOSTILE, variant="none", embodiment=HOSTILE)
    records += make_cell({"standard": 0.5}, task="a; rm -rf b", seeds=1)
    for index, record in enumerate(records):
        record.run_id = f"run-{index}"
        record.provenance.device = HOSTILE
        record.base_policy.warning = HOSTILE
    write(tmp_path, records)
    rows = json.loads(audit(tmp_path).read_text())
    rows[0] |= {"task": HOSTILE, "embodiment": HOSTILE, "variant": HOSTILE}
    (tmp_path / "summary.json").write_text(json.dumps(rows))
    generate([tmp_path / "results"], tmp_path, tmp_path / "summary.json")
    parser = markdown.MarkdownIt("commonmark").enable(["table", "strikethrough"])
    page = (tmp_path / "LEADERBOARD.md").read_text()
    tokens = [token for block in parser.parse(page) for token in [block, *(block.children or [])]]
    raw = {t.content.strip() for t in tokens if t.type in ("html_block", "html_inline")}
    assert all(re.fullmatch(r"<br>|</?details>(\n<summary>[\w', -]+</summary>)?", r) for r in raw)
    links = {str(t.attrs.get("href") or t.attrs.get("src")) for t in tokens if t.attrs}
    assert all(
        re.fullmatch(r"None|records.csv|PAPER.md|(results|figures)/[\w.%-]+", link)
        for link in links
    )
    plain = " ".join(t.content for t in tokens if t.type == "text")
    assert "alert" not in plain
    assert "symsteer audit --task" not in page
    assert len(list((tmp_path / "figures").glob("map-*.svg"))) == 1
    for path in (tmp_path / "figures").iterdir():
        assert re.fullmatch(r"[a-z0-9-]+\.svg", path.name)
        ElementTree.fromstring(path.read_bytes())


def test_uneven_cells_are_drawn_with_their_coverage(tmp_path: Path) -> None:
    """An agent in one of two cells, and twins of an agent, neither hide nor break anything."""
    generator = np.random.default_rng(0)
    records = make_cell({"base": 0.3, "standard": 0.5, "equivariant": 0.6})
    records += make_cell({"base": 0.3, "standard": 0.5}, variant="wind:1")
    # All differences of this cell are alike: its intervals have no width.
    alike = {"base": [0.3], "standard": [0.0] * 7, "equivariant": [0.0, *[1.0] * 6]}
    records += make_cell(alike, seeds=7, variant="wind:0.5")
    twin = make_record([make_evaluation(generator.random(40) < 0.5)], learning_rate=1e-3, seed=0)
    records.append(twin.model_copy(update={"run_id": "twin"}))
    write(tmp_path, records)
    generate([tmp_path / "results"], tmp_path, audit(tmp_path))
    text = text_of(tmp_path)
    assert "Same agent with different settings, in rows of their own" in text
    alike_rise = "`equivariant` 0.00 [0.00, 0.00]; `standard` 0.00 [0.00, 0.00]."
    assert f"From the fourth to the last fifth of the budget: {alike_rise}" in text
    _, _, *pairs = table_after(text, "Probability of improvement")
    assert pairs[0][0] == "`equivariant` > `standard`"
    assert pairs[0][1].endswith("(1; 5, 5)")
    assert pairs[0][2].endswith("(1; 7, 7)")
