"""The tables of feedback_efficiency.md, from rows with known answers."""

from tests.benchmarks import feedback_report
from tests.benchmarks.feedback_report import Row


def row(user: str, gain: float, *, seed: int = 0, pooled: bool = False, rule: str = "entropy") -> Row:
    """One chain of the structured model at 50 labels."""
    named = {"user": user, "model": "structured", "strategy": rule, "pooled_prior": pooled, "seed": seed}
    return named | {"labels": 50, "gain_percent": gain, "accuracy": 0.9}


def test_a_line_is_the_mean_over_users_of_the_first_seed() -> None:
    rows = [row("slow", 10.0), row("wide", 14.0), row("slow", 99.0, seed=1), row("slow", 20.0, pooled=True)]
    lines = feedback_report.tables({"feeding": rows}).splitlines()
    assert "| structured, by entropy | 12.0 ± 2.0 (0.900) |" in lines
    assert "| structured, by entropy, pooled prior | 20.0 (0.900) |" in lines, "one user has no standard error"


def test_people_of_the_population_stand_in_a_table_of_their_own() -> None:
    page = feedback_report.tables({"feeding": [row("slow", 10.0), row("person-3", 30.0)]})
    named, people = page.split("### ")[1:]
    assert "10.0" in named
    assert "30.0" in people
    assert "30.0" not in named
