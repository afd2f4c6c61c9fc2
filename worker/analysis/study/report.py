"""One report: tables in, contents and figures out. make_report is what the worker's processes run.

Contents (stored as Report.contents): ``version``, ``blinded``, ``plan`` (standing, planned tests, in_words: see
app.services.studies.preregistration), ``ratings`` (see statistics), ``guesses`` (see guesses; None where it is not
asked), ``head_to_heads`` (see bradley_terry; None where there are none, or letters hide methods), ``instruments`` (see
scales), ``answers`` and ``change`` (see answers).
Figures by name, each as SVG and PNG (see figures).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]


@dataclass(frozen=True)
class Tables:
    """The exported tables that a report is made from, and what the study says about them."""

    participants: Sequence[str]
    """codes of everybody who takes part and has not withdrawn"""
    ratings: Sequence[Row]
    answers: Sequence[Row]
    """a row per participant, see app.services.answers.answer_figures"""
    evaluations: Sequence[Row]
    groups: Sequence[str]
    """methods in their order, or letters while blinded; empty in a study without evaluation"""
    blinded: bool = False
    plan: Mapping[str, Any] = field(default_factory=dict)
    window: int = 30
    """answers in the running accuracy"""
    guesses: Sequence[Row] | None = None
    """who named which robot as made for them; None: that is not asked"""
    instruments: Sequence[Row] = ()
    """standard questionnaires with what people filled in, see scales"""
    between: bool = False
    """whether people in different arms met different methods"""
    bound: float = 0.5
    """of equivalence, in points of the ratings' scale"""
    head_to_heads: Sequence[Row] | None = None
    """rows of the table headtoheads; None: there are none, or the study is blinded"""
    version: int = 0
    """of the contents, see app.services.runs.reports"""
    columns: dict[str, Sequence[str]] = field(default_factory=dict)
    """of each table by name: an empty table has no rows to read them from"""


def make_report(tables: Tables) -> tuple[dict[str, Any], dict[str, dict[str, bytes]]]:
    """The contents, and the figures as {name: {format: file}}."""
    # Takes seconds, and the worker, which only names this function, needs none of it.
    from worker.analysis.study import figures

    contents = contents_of(tables)
    return contents, figures.all_figures(contents)


def contents_of(tables: Tables) -> dict[str, Any]:
    """All numbers of a report, without its figures."""
    from worker.analysis.study import answers, statistics
    from worker.analysis.study.guesses import guess_report
    from worker.analysis.study.scales import scale_reports

    return {
        "version": tables.version,
        "blinded": tables.blinded,
        "plan": dict(tables.plan),
        "ratings": statistics.rating_report(
            _frame(tables, "ratings"),
            tables.groups,
            by="letter" if tables.blinded else "method",
            compare=not tables.blinded,
            between=tables.between,
            bound=tables.bound,
        ),
        "guesses": None if tables.guesses is None else guess_report(tables.guesses, len(tables.groups)),
        "head_to_heads": None if tables.head_to_heads is None else _head_to_heads(tables),
        "instruments": scale_reports(
            tables.instruments, tables.groups, compare=not tables.blinded, between=tables.between
        ),
        "answers": answers.answer_report(tables.answers, tables.window),
        "change": answers.change_report(_frame(tables, "evaluations"), tables.participants),
    }


def _head_to_heads(tables: Tables) -> dict[str, Any]:
    from worker.analysis.study.bradley_terry import head_to_head_report

    rows = [
        {**each, "left": each["left_method"], "right": each["right_method"]}
        for each in tables.head_to_heads or ()
        if each["counts"]
    ]
    return head_to_head_report(rows, tables.groups)


def _frame(tables: Tables, name: str) -> "pd.DataFrame":
    import pandas as pd

    frame = pd.DataFrame(getattr(tables, name), columns=tables.columns.get(name))
    return frame[frame["counts"].astype(bool)] if name == "ratings" and not frame.empty else frame
