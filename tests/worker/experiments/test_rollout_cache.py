"""Rollouts that are kept for many fits say what a study's do."""

from pathlib import Path

import numpy as np
import pytest

from worker.compute import simulation
from worker.experiments.rollout_cache import RolloutCache


def test_rollouts_of_archived_policies_say_what_the_frozen_policy_would_have_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shield is made of how far a filter went from it: one that went nowhere is not let go anywhere."""
    (name, policy), *_ = simulation.archived_policies("feeding").items()
    monkeypatch.setattr(simulation, "archived_policies", lambda task: {name: policy})
    for _ in ("driven", "kept"):
        archived, *_ = RolloutCache("feeding", tmp_path).archived([0])
        (driven,) = archived.driven
        frozen = simulation.reference_policy("feeding").mean(driven.observations[:-1])
        np.testing.assert_allclose(driven.reference_actions, frozen, atol=1e-6)
        assert np.abs(driven.reference_actions - driven.actions).max() > 0.1
