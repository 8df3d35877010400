"""The sections of the leaderboard: each a file that computes, renders and explains one statistic.

To add one, write a file here that ends with a `Section` (`spread_of_results` is a short one),
import it in `page` and name it in `SECTIONS` there. The page, the site, the figures and the CSV
files take it from that list. What is known of a run is in `runs.Run`. Tests are in
`tests/leaderboard/sections/`: `make_cell`, `summary_of` and `view_of` of `record_factory` make
records with known success.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, Literal, NamedTuple, TypeVar

from symsteer.leaderboard.defects import Audit
from symsteer.leaderboard.plots import Figure
from symsteer.leaderboard.rows import Summary
from symsteer.leaderboard.study import Study
from symsteer.leaderboard.text import image

Result = TypeVar("Result")


class Page(NamedTuple):
    """A page of its own: what its file's name is made of, its title, and its blocks of markdown."""

    words: Sequence[str]
    title: str
    blocks: list[str]


def one_page(
    word: str, title: str, render: Callable[[Result, View], list[str]]
) -> Callable[[Result, View], list[Page]]:
    """The blocks of a section as a page whose file is called by a word, for `Section.apart`."""

    def pages(result: Result, view: View) -> list[Page]:
        blocks = render(result, view)
        return [Page([word], title, blocks)] if blocks else []

    return pages


@dataclass(frozen=True)
class Section(Generic[Result]):
    """One statistic, or one view of the records.

    Attributes:
        title: its heading; neighbours with the same title share it. A section without a title
            brings its headings along.
        compute: the statistic; the same findings give the same result.
        render: the result as blocks of markdown, the first of them what it means and how to read
            it; none leave the section out. Text of a record stands in code spans alone (`text`).
        where: "first" is the first screen of the page and of the site; "folded" sections are opened
            by a reader of the page, and are the site's findings; "page" is the page alone, where
            the site has other pages; "site" is the site alone, where the page has another file.
        files: further files of the leaderboard by name, such as a CSV; an empty text is no file.
        figures: of the result; `render` places them by `View.drawn`.
        apart: the same as pages of its own, for a leaderboard that is too large for one page.
    """

    title: str
    compute: Callable[[Findings], Result]
    render: Callable[[Result, View], list[str]]
    where: Literal["first", "folded", "page", "site"] = "folded"
    files: Mapping[str, Callable[[Result, View], str]] = field(default_factory=dict, hash=False)
    figures: Callable[[Result, Summary], Sequence[Figure]] = lambda result, summary: ()
    apart: Callable[[Result, View], Sequence[Page]] | None = None


@dataclass(frozen=True)
class Findings:
    """What is known: the records' summary, the audit of the defects, the study, every statistic."""

    summary: Summary
    audit: Audit
    study: Study
    _results: dict[Section[Any], Any] = field(default_factory=dict, repr=False)

    def of(self, section: Section[Result]) -> Result:
        """The result of a section, computed once.

        Raises UserError for names in the study that nothing has (`claims`).
        """
        if section not in self._results:
            self._results[section] = section.compute(self)
        return self._results[section]


Links = Mapping[Path, str | None]
"""Address of each record relative to the page, None to show none."""


@dataclass(frozen=True)
class View:
    """What is shown on the page or the site, and where records and figures are from there."""

    findings: Findings
    links: Links = field(default_factory=dict)
    figures: Sequence[tuple[Figure, str]] = ()
    """With their addresses."""

    @property
    def summary(self) -> Summary:
        return self.findings.summary

    def drawn(self, *place: str, kind: str = "") -> list[str]:
        """The figures of a place, or the one of a kind, as blocks of markdown."""
        return [
            image(figure.text, address)
            for figure, address in self.figures
            if figure.place == place and kind in ("", figure.kind)
        ]

    def blocks(self, section: Section[Any]) -> list[str]:
        """A section as blocks of markdown."""
        return section.render(self.findings.of(section), self)

    def below(self) -> View:
        """The same for a page in a folder beside the figures."""
        links = {path: link and f"../{link}" for path, link in self.links.items()}
        return replace(self, links=links, figures=[(one, f"../{a}") for one, a in self.figures])
