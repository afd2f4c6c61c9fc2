"""Policies that are refined once for everybody: how they are made, and those that ship."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from app.installed_tasks import catalogue
from tests.benchmarks.archived_policies import MODE, tables
from worker.__main__ import main
from worker.compute import simulation
from worker.experiments import archive_policies, fit_response_surface
from worker.experiments.archive_policies import ARCHETYPES, Archetype
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import FilterConfig, FilterProblem
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.reinforcement.archived_policy import best_archived
from worker.ml.reinforcement.refinement import Refinement
from worker.ml.reinforcement.refinement_gate import ArchivedDraft

ARCHIVES = [name for name in catalogue.names() if simulation.archive_folder(name).exists()]
FEW = FilterConfig(gate_scenarios=3, check_scenarios=2, watch_scenarios=1, mode_attempts=1, success_tolerance=1.0)
SHORT = Refinement(
    steps=1_200,
    warm_up_steps=400,
    imitation_steps=100,
    critic_first_updates=20,
    critic_again_updates=20,
    hidden=16,
)


def test_policies_are_made_one_after_the_other_each_once_until_asked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    request.addfinalizer(simulation.archived_policies.cache_clear)
    monkeypatch.setattr(simulation, "archive_folder", lambda task: tmp_path / "refined")
    monkeypatch.setattr(archive_policies, "POOL_SCENARIOS", 2)
    monkeypatch.setattr(archive_policies, "TEST_SCENARIOS", 1)
    monkeypatch.setattr(archive_policies, "LARGEST_LOSS", 1.0)
    monkeypatch.setattr(archive_policies, "SCENARIOS_AROUND", fit_response_surface.BLOCK)
    monkeypatch.setattr(fit_response_surface, "MODES_PER_SCENARIO", 1)
    began = list[int]()

    def noting(*asked: Any) -> list[ArchivedDraft]:
        began.append(len(asked[2]))
        return best_archived(*asked)

    def passing(
        problem: FilterProblem, mode: FilterDraft, best: Any, drafts: Sequence[FilterDraft], *_: Any
    ) -> FilterDraft:
        """So short a training makes nothing that the gate would let through."""
        return replace(drafts[0], weights=drafts[0].weights.changed(gate=0.8 if len(began) == 3 else 1.0))

    monkeypatch.setattr(archive_policies, "best_archived", noting)
    monkeypatch.setattr(archive_policies, "gate_refined", passing)
    make = (Archetype("even"), Archetype("level", "tilt_rad"), Archetype("wide", "lateral_offset_m", 1.0))
    record = archive_policies.archive_policies("feeding", tmp_path / "work", make, SHORT, FEW)
    assert [each["kept"] for each in record["archetypes"]] == [True, True, False], "the last is no whole policy"
    assert began == [0, 1, 2]
    assert sorted(file.stem for file in (tmp_path / "refined").glob("*.safetensors")) == ["even", "level"]
    assert json.loads((tmp_path / "refined" / "archive.json").read_text()) == record
    left = [file.name for file in (tmp_path / "work").iterdir() if not file.name.endswith("-done")]
    assert left == ["rollouts"], "what it needs to go on is cleared away"
    for name in ("even", "level"):
        around = simulation.surface_around("feeding", name)
        assert around is not None
        assert around.coefficients.any()

    with monkeypatch.context() as patched:
        patched.setattr(archive_policies, "refine", lambda *_: pytest.fail("it was trained again"))
        changed, other = (tmp_path / "refined" / f"{name}.safetensors" for name in ("level", "even"))
        changed.write_bytes(other.read_bytes())
        assert archive_policies.archive_policies("feeding", tmp_path / "work", make, SHORT, FEW) == record
        assert changed.read_bytes() == other.read_bytes(), "what was improved since is not taken back"

    (tmp_path / "refined" / ".soon.1.safetensors").write_bytes(b"what a killed program left behind")
    assert list(simulation.archived_policies.__wrapped__("feeding")) == ["even", "level"]
    before = {file.name: file.read_bytes() for file in (tmp_path / "refined").glob("[a-z]*.safetensors")}
    (tmp_path / "work" / "level-done").unlink()
    again = archive_policies.archive_policies("feeding", tmp_path / "work", make[1:2], SHORT, FEW)
    assert began == [0, 1, 2, 2], "whoever is refined again begins as the best of all that are there"
    assert again["archetypes"][:3] == record["archetypes"]
    assert [(each["name"], each["signal"], each["kept"]) for each in again["archetypes"][3:]] == [
        ("level_2", "tilt_rad", True)
    ]
    assert all((tmp_path / "refined" / name).read_bytes() == policy for name, policy in before.items())
    assert list(simulation.archived_policies.__wrapped__("feeding")) == ["even", "level", "level_2"]

    def archived() -> list[str]:
        return sorted(file.stem for file in (tmp_path / "refined").glob("[a-z]*.safetensors"))

    def archived_already(problem: FilterProblem, mode: FilterDraft, *_: Any) -> FilterDraft:
        """Nothing was learned that is better than one of those that are there."""
        policy = simulation.archived_policies("feeding")["even"]
        return replace(mode, weights=mode.weights.changed(refined=policy.weights, gate=1.0))

    (tmp_path / "work" / "level-done").unlink()
    with monkeypatch.context() as patched:
        patched.setattr(archive_policies, "gate_refined", archived_already)
        archive_policies.archive_policies("feeding", tmp_path / "work", make[1:2], SHORT, FEW)
    assert archived() == ["even", "level", "level_2"], "what was archived before is not archived again"

    monkeypatch.setattr(archive_policies, "LARGEST_LOSS", -2.0)
    (tmp_path / "work" / "level-done").unlink()
    archive_policies.archive_policies("feeding", tmp_path / "work", make[1:2], SHORT, FEW)
    assert archived() == ["even", "level", "level_2"], "what loses the task is not archived"


@pytest.mark.parametrize("task", ARCHIVES)
def test_an_archive_ships_with_the_policies_that_its_record_names(task: str) -> None:
    record = json.loads((simulation.archive_folder(task) / "archive.json").read_text())
    shipped = simulation.archived_policies(task)
    assert shipped
    assert sorted(shipped) == sorted(each["name"] for each in record["archetypes"] if each["kept"])
    made_for = {(each["signal"], each["sign"]) for each in record["archetypes"]}
    assert made_for <= {(each.signal, each.sign) for each in ARCHETYPES}
    assert record["steps"] == Refinement().steps
    reference = simulation.reference_policy(task)
    around = [file.stem for file in simulation.surface_around_file(task, "even").parent.iterdir()]
    assert sorted(around) == sorted(shipped), "modes were explored around each, and around nothing else"
    for name, policy in shipped.items():
        surface = simulation.surface_around(task, name)
        assert surface is not None
        assert surface.coefficients.any()
        assert isinstance(policy, GaussianPolicy)
        assert policy.offset.tolist() == reference.weights["offset"].tolist()
        assert policy.action_size == reference.action_size


def test_the_page_says_whom_each_policy_serves_best_and_what_would_be_lost_without_it() -> None:
    gains = {
        "named": {"a": (1.0, 2.0, 3.0)},
        "drawn": {"b": (1.0, 5.0, 2.0), "c": (1.0, 3.0, 2.0), "d": (9.0, 1.0, 3.0)},
        "outside": {"e": (0.0, 1.0, 1.5), "f": (0.0, -1.0, -2.0), "g": (4.0, 0.0, 5.0)},
    }
    outcome = {"success_points": -0.5, "pressed_percent": 1.0}
    rows = [
        {"task": "feeding", "group": group, "user": user, "policy": policy, "gain_percent": gain, **outcome}
        for group, users in gains.items()
        for user, each in users.items()
        for policy, gain in zip((MODE, "even", "level"), each, strict=True)
    ]
    page = tables(rows)
    assert "| feeding | drawn, 3 | +3.7 [-7.8, +15.1] | +3.7 [+0.8, +6.5] | +5.7 [-1.9, +13.3] | 67 % |" in page
    assert "| feeding | `even` | -0.5 | 1.0 % | 67 % | 1.33 | 0 % | 0.00 |" in page
    assert "| feeding | `level` | -0.5 | 1.0 % | 0 % | 0.00 | 67 % | 0.50 |" in page


def test_a_task_that_was_not_explored_is_told_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(simulation, "surface_file", lambda task: tmp_path / "none.safetensors")
    assert main(["archive-policies", "--task", "feeding", "--work-directory", str(tmp_path / "work")]) == 1
    assert "`python -m worker explore --task feeding` fits one" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
