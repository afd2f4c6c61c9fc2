"""The response surface of modes: what it learns, whom it serves, when it stays away."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy

from worker.domain.trajectory import SIGNALS
from worker.ml.filters.fitting.mode_archive import ModeArchive, tail_growth_n
from worker.ml.filters.fitting.response_surface import ResponseSurface, best_mode, fit, monomials
from worker.tasks.feeding.environment import FEEDING

FAMILY = FEEDING.modes
SPEED, HEIGHT = SIGNALS.index("speed_m_s"), SIGNALS.index("height_above_target_m")


@pytest.fixture(scope="module")
def surface() -> ResponseSurface:
    """A world in which speed_far decides the speed, from_below the height, and haste near the mouth costs success."""
    rng = np.random.default_rng(0)
    modes = FAMILY.sample(600, rng)
    deltas = 0.01 * rng.standard_normal((600, len(SIGNALS)))
    deltas[:, SPEED] += 2 * modes[:, 0] + 0.5 * modes[:, 0] ** 2 + 3 * modes[:, 1]
    deltas[:, HEIGHT] -= modes[:, 2]
    success = rng.random(600) < 0.98 - 1.2 * np.maximum(modes[:, 1], 0.0)
    return fit(FAMILY, modes, deltas, success.astype(np.float64))


def likes(**weights: float) -> np.ndarray:
    """Weights on the signals."""
    return np.array([weights.get(name, 0.0) for name in SIGNALS])


def test_the_reference_policy_changes_nothing(surface: ResponseSurface) -> None:
    signals, success = surface.predict(FAMILY.reference)
    assert np.abs(signals).max() == 0.0
    assert success == 0.0


def test_it_predicts_modes_it_has_not_seen(surface: ResponseSurface) -> None:
    modes = FAMILY.sample(50, np.random.default_rng(9))
    signals, _ = surface.predict(modes)
    expected = 2 * modes[:, 0] + 0.5 * modes[:, 0] ** 2 + 3 * modes[:, 1]
    np.testing.assert_allclose(signals[:, SPEED], expected, atol=0.1)


def test_people_who_want_opposite_things_get_opposite_modes(surface: ResponseSurface) -> None:
    slow = best_mode(surface, likes(speed_m_s=-1.0), seed=0)
    quick = best_mode(surface, likes(speed_m_s=1.0), seed=0)
    low = best_mode(surface, likes(height_above_target_m=-1.0), seed=0)
    assert slow[0] < -0.4 < 0.4 < quick[0]
    assert low[2] > 0.4


def test_a_mode_that_would_cost_success_is_not_chosen(surface: ResponseSurface) -> None:
    wanted = best_mode(surface, likes(speed_m_s=1.0), seed=0)
    reckless = best_mode(surface, likes(speed_m_s=1.0), seed=0, penalty=0.0)
    assert surface.predict(wanted)[1] > -0.05
    assert surface.predict(reckless)[1] < -0.2


def test_modes_stay_in_their_ranges_and_are_repeatable(surface: ResponseSurface) -> None:
    chosen = best_mode(surface, likes(speed_m_s=-1.0, height_above_target_m=-2.0), seed=3)
    assert (chosen >= surface.low).all()
    assert (chosen <= surface.high).all()
    np.testing.assert_array_equal(chosen, best_mode(surface, likes(speed_m_s=-1.0, height_above_target_m=-2.0), seed=3))


def test_somebody_who_cares_about_nothing_keeps_the_reference_policy(surface: ResponseSurface) -> None:
    assert best_mode(surface, likes(), seed=0).tolist() == FAMILY.reference.tolist()


def test_with_caution_what_the_members_disagree_about_is_not_gambled_on(surface: ResponseSurface) -> None:
    """Sure about the height, undecided about the speed."""
    members = np.array([likes(height_above_target_m=-1.0, speed_m_s=speed) for speed in (-3.0, 3.2)])
    chosen, bold = (best_mode(surface, members, seed=0, caution=caution) for caution in (1.0, 0.0))
    assert chosen[2] > 0.4
    assert abs(surface.predict(chosen)[0][SPEED]) < 0.1 < 0.4 < surface.predict(bold)[0][SPEED]


def test_of_members_that_disagree_the_mean_decides(surface: ResponseSurface) -> None:
    members = np.array([likes(height_above_target_m=-1.0, speed_m_s=speed) for speed in (-1.0, 3.0)])
    np.testing.assert_array_equal(
        best_mode(surface, members, seed=0),
        best_mode(surface, likes(height_above_target_m=-1.0, speed_m_s=1.0), seed=0),
    )


def test_one_crash_does_not_bend_the_surface() -> None:
    rng = np.random.default_rng(0)
    modes = FAMILY.sample(600, rng)
    deltas = np.zeros((600, len(SIGNALS)))
    deltas[:, SPEED] = modes[:, 0]
    crashed = deltas.copy()
    crashed[17, SPEED] = 1e5
    calm, shaken = (fit(FAMILY, modes, each, np.zeros(600)).coefficients for each in (deltas, crashed))
    np.testing.assert_allclose(shaken, calm, atol=0.05)


def test_it_survives_storage(surface: ResponseSurface, tmp_path: Path) -> None:
    surface.save(tmp_path / "surface.safetensors")
    loaded = ResponseSurface.load(tmp_path / "surface.safetensors", FAMILY)
    modes = FAMILY.sample(5, np.random.default_rng(0))
    np.testing.assert_allclose(loaded.predict(modes)[0], surface.predict(modes)[0], atol=1e-5)
    assert surface.to_bytes() == loaded.to_bytes()


def archive(success_of_the_fastest: float = 0.0, force_of_the_fastest_n: float = 0.0) -> ModeArchive:
    """Three modes that make the robot faster, the later the more."""
    signals = np.zeros((3, len(SIGNALS)))
    signals[:, SPEED] = [1.0, 2.0, 3.0]
    modes = FAMILY.sample(3, np.random.default_rng(1))
    success, force_n = ([0.0, 0.0, each] for each in (success_of_the_fastest, force_of_the_fastest_n))
    return ModeArchive(modes, signals, np.array(success), np.array(force_n))


def test_an_archive_survives_storage(surface: ResponseSurface) -> None:
    stored = replace(surface, archive=archive()).to_bytes()
    loaded = ResponseSurface.from_bytes(stored, FAMILY)
    assert loaded.archive
    np.testing.assert_allclose(loaded.archive.modes, archive().modes, atol=1e-6)
    np.testing.assert_array_equal(loaded.archive.signals, archive().signals)
    assert ResponseSurface.from_bytes(surface.to_bytes(), FAMILY).archive is None


def test_an_archive_from_before_forces_were_kept_is_not_used(surface: ResponseSurface) -> None:
    with_forces = safetensors.numpy.load(replace(surface, archive=archive()).to_bytes())
    del with_forces["archive/force_growth_n"]
    config = {"axes": list(FAMILY.names), "kind": "response surface", "signals": list(SIGNALS)}
    of_before = safetensors.numpy.save(with_forces, metadata={"config": json.dumps(config)})
    assert ResponseSurface.from_bytes(of_before, FAMILY).archive is None


def test_the_best_of_an_archive_is_by_what_its_modes_did_and_keeps_the_task() -> None:
    of_three, likes_it = archive(), likes(speed_m_s=1.0)
    members = np.array([likes_it, -0.5 * likes_it])
    for weights in (likes_it, members):
        np.testing.assert_array_equal(of_three.best(weights), of_three.modes[2])
    np.testing.assert_array_equal(archive(success_of_the_fastest=-0.1).best(likes_it), of_three.modes[1])
    assert of_three.best(-likes_it) is None


def test_the_best_of_an_archive_does_not_press() -> None:
    pressing, likes_it = archive(force_of_the_fastest_n=9.0), likes(speed_m_s=1.0)
    np.testing.assert_array_equal(pressing.best(likes_it, most_growth_n=5.0), pressing.modes[1])
    np.testing.assert_array_equal(pressing.best(likes_it, most_growth_n=10.0), pressing.modes[2])
    everywhere = replace(pressing, force_growth_n=np.full(3, 9.0))
    assert everywhere.best(likes_it, most_growth_n=5.0) is None


def test_modes_like_one_that_pressed_are_not_sought(surface: ResponseSurface) -> None:
    quickest = best_mode(surface, likes(speed_m_s=1.0), seed=0)
    modes = np.array([quickest, 0.9 * quickest, -quickest, FAMILY.reference])
    np.testing.assert_array_equal(surface.forces.growth_n_of(modes), np.zeros(4))
    by_trial = surface.forces.with_observed(quickest, 9.0)
    quickest_of_archive = ModeArchive(modes[:1], surface.predict(modes[:1])[0], np.zeros(1), np.array([9.0]))
    by_archive = replace(surface, archive=quickest_of_archive).forces
    for known in (by_trial, by_archive):
        foreseen = known.growth_n_of(modes)
        assert 7.0 < foreseen[1] < foreseen[0] < 9.0
        assert abs(foreseen[2]) < 0.2 * foreseen[0]
        assert foreseen[3] == 0.0
        careful = best_mode(surface, likes(speed_m_s=1.0), seed=0, forces=known, most_growth_n=5.0)
        assert known.growth_n_of(careful) <= 5.0
        speeds = surface.predict(np.array([careful, quickest]))[0][:, SPEED]
        assert 0.5 * speeds[1] < speeds[0] < speeds[1]


def test_growth_of_forces_is_what_few_scenarios_exceed() -> None:
    assert tail_growth_n(np.where(np.arange(200) < 6, 12.0, 1.0)) == pytest.approx(1.0)  # 3 of 100
    assert tail_growth_n(np.where(np.arange(200) < 8, 12.0, 1.0)) == pytest.approx(12.0)  # 4 of 100


def test_what_the_regression_gets_wrong_in_tried_modes_is_expected_of_modes_like_them(surface: ResponseSurface) -> None:
    """Modes with this speed and height are quicker than a cubic says; that one fails once in ten may be chance."""
    tried, like, unlike = [0.4, -0.5, 0.4, 0.5, 0], [0.37, -0.45, 0.4, 0.45, 0], [-0.5, 0.5, -0.6, -0.6, 0]
    modes = np.array([tried, like, unlike, FAMILY.reference])
    before, success_before = surface.predict(modes)
    measured = before[0].copy()
    measured[SPEED] += 1.0
    known = replace(surface, archive=ModeArchive(modes[:1], measured[None], success_before[:1] - 0.1, np.zeros(1)))
    after, success_after = known.predict(modes)
    gained = (after - before)[:, SPEED]
    assert gained[0] == pytest.approx(0.9, abs=0.02)
    assert 0.8 < gained[1] < gained[0]
    assert abs(gained[2]) < 0.05
    assert gained[3] == 0.0
    np.testing.assert_array_equal(success_after, success_before)
    assert np.delete(after - before, SPEED, axis=1) == pytest.approx(0.0, abs=1e-9)


def test_a_surface_of_other_axes_is_refused(surface: ResponseSurface) -> None:
    fewer = replace(FAMILY, axes=FAMILY.axes[:3])
    with pytest.raises(ValueError, match="other signals or axes"):
        ResponseSurface.from_bytes(surface.to_bytes(), fewer)


def test_there_are_no_constant_and_all_first_second_and_pure_third_orders() -> None:
    assert monomials(np.zeros(2)).tolist() == [0.0] * 7
    assert monomials(np.array([2.0, 3.0])).tolist() == [2, 3, 4, 6, 9, 8, 27]


def test_rollouts_of_one_mode_change_what_is_expected_of_its_neighbours_and_hardly_more(
    surface: ResponseSurface,
) -> None:
    tried, near, far = [0.4, -0.6, 0, 0, 0], [0.35, -0.55, 0, 0, 0], [-0.4, 0.2, 0, 0, 0]
    modes, observed = np.array([tried, near, far]), np.array([1.0, 0.0] * 40)
    before = surface.predict(modes)[1]
    after = surface.with_observed(modes[0], np.zeros((80, len(SIGNALS))), observed).predict(modes)[1]
    assert after[0] < -0.25
    assert after[1] < before[1] - 0.2
    assert abs(after[2] - before[2]) < 0.5 * abs(after[1] - before[1])


def test_it_learns_from_new_rollouts_as_if_it_had_had_them_from_the_start() -> None:
    rng = np.random.default_rng(3)
    modes, deltas, success = (
        FAMILY.sample(300, rng),
        rng.standard_normal((300, len(SIGNALS))),
        (rng.random(300) < 0.8).astype(np.float64),
    )
    modes[-20:] = modes[-1]
    outliers = np.quantile(deltas, [0.005, 0.995], axis=0)
    deltas = np.clip(deltas, *outliers)
    whole = fit(FAMILY, modes, deltas, success)
    later = fit(FAMILY, modes[:-20], deltas[:-20], success[:-20]).with_observed(modes[-1], deltas[-20:], success[-20:])
    np.testing.assert_allclose(later.coefficients, whole.coefficients, atol=0.02)
    np.testing.assert_allclose(later.predict(modes)[1], whole.predict(modes)[1], atol=0.05)
