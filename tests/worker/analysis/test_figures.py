"""Figures are the same bytes every time, keep text as text, and never tell what is blinded."""

from typing import Any

import pytest

from tests.worker.analysis.test_statistics import METHODS, ratings
from worker.analysis.study import figures
from worker.analysis.study.answers import answer_report, change_report
from worker.analysis.study.report import Tables, make_report
from worker.analysis.study.statistics import rating_report


@pytest.fixture(scope="module")
def contents() -> dict[str, Any]:
    evaluations = [
        {
            "participant": f"P{number:02d}",
            "label_count": 200,
            "scenarios": 100,
            "newest": True,
            "measure": measure,
            "reference": 2.0,
            "filtered": 2.0 + 0.1 * number,
            "delta": 0.1 * number,
            "low": 0.0,
            "high": 0.3,
        }
        for number in range(1, 5)
        for measure in ("success", "preference", "C_d", "C_v")
    ]
    answers = [
        {
            "participant": f"P{number:02d}",
            "labels": 40,
            "accuracy": {"accuracy": 0.75},
            "foresight": "better",
            "curve": [[count, 0.5 + count / 100] for count in range(5, 41)],
            "test_retest": {"asked": 0, "same": 0},
        }
        for number in (1, 2)
    ]
    tables = Tables(
        participants=[f"P{number:02d}" for number in range(1, 5)],
        ratings=[{**row, "counts": True} for row in ratings().to_dict("records")],
        answers=answers,
        evaluations=evaluations,
        groups=METHODS,
        head_to_heads=[
            {
                "participant": f"P{number:02d}",
                "left_method": METHODS[first],
                "right_method": METHODS[second],
                "response": "right" if number % 4 else "left",
                "counts": True,
            }
            for number in range(1, 9)
            for first, second in ((0, 1), (1, 2), (0, 2))
        ],
    )
    return make_report(tables)[0]


@pytest.fixture(scope="module")
def drawn(contents: dict[str, Any]) -> dict[str, dict[str, bytes]]:
    return figures.all_figures(contents)


def test_every_figure_is_drawn_and_is_the_same_bytes_every_time(
    contents: dict[str, Any], drawn: dict[str, dict[str, bytes]]
) -> None:
    assert set(drawn) == {
        "ratings",
        "ratings_of_each_person",
        "head_to_heads",
        "learning_curves",
        "success_against_preference",
        "cost_changes",
    }
    assert figures.all_figures(contents) == drawn


def test_text_in_svg_is_text_and_png_has_300_dpi(drawn: dict[str, dict[str, bytes]]) -> None:
    files = drawn["ratings"]
    assert b"Satisfaction</text>" in files["svg"]
    assert b">PbARL</text>" in files["svg"]
    width = int.from_bytes(files["png"][16:20])
    assert width > 6 * figures.DPI


def test_the_strongest_robot_is_on_top(contents: dict[str, Any], drawn: dict[str, dict[str, bytes]]) -> None:
    svg = drawn["head_to_heads"]["svg"].decode()
    found = sorted(contents["head_to_heads"]["strengths"], key=lambda each: -each["strength"])
    names = [figures.name_of(each["group"]) for each in found]
    assert sorted(names, key=lambda name: svg.index(f">{name}</text>")) == names


def test_significant_comparisons_have_a_star_and_others_say_so(
    contents: dict[str, Any], drawn: dict[str, dict[str, bytes]]
) -> None:
    svg = drawn["ratings"]["svg"].decode()
    stars = [
        comparison["two_sample_t"]["star"]
        for scale in contents["ratings"]["scales"].values()
        for comparison in scale["comparisons"]
    ]
    assert svg.count(">*</text>") == sum(stars)
    assert svg.count(">n.s.</text>") == len(stars) - sum(stars)


def test_figures_of_a_blinded_study_know_letters_only() -> None:
    rows = ratings().assign(letter=lambda each: each.method.map(dict(zip(METHODS, "ABC", strict=True))))
    report = rating_report(rows, "ABC", by="letter", compare=False)
    nothing = rows.iloc[:0].assign(newest=True, measure="")
    contents = {
        "ratings": report,
        "answers": answer_report([], 30),
        "change": change_report(nothing, []),
    }
    drawn = figures.all_figures(contents)
    assert set(drawn) == {"ratings", "ratings_of_each_person"}
    for files in drawn.values():
        assert b"Robot" in files["svg"]
        assert not any(name.encode() in files["svg"] for name in ("PbARL", "PrefFT", "Pre-trained"))


def test_a_study_without_anything_has_no_figures() -> None:
    contents, files = make_report(
        Tables(
            [],
            [],
            [],
            [],
            [],
            columns={
                "evaluations": ["participant", "newest", "measure"],
                "ratings": ["participant", "method", "satisfaction", "personalisation"],
            },
        )
    )
    assert files == {}
    assert contents["ratings"]["ratings"] == 0
