"""Signals, costs and rewards of one control step, against cases worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from worker.domain.trajectory import COSTS, SIGNALS
from worker.sim.costs import base_weights, cost_items, preference_rewards, signal_weights, stakes
from worker.sim.measures import StepMeasures, StepOutcome, TaskReward
from worker.tasks.feeding.environment import FEEDING
from worker.tasks.scratching.environment import SCRATCHING

STILL = StepMeasures(
    tool_m=np.array([0.0, -0.4, 1.2]),
    tool_up=np.array([0.0, 0.0, 1.0]),
    target_m=np.array([0.0, 0.0, 1.2]),
    outward=np.array([0.0, -1.0, 0.0]),
    speed_m_s=0.0,
    speed_squared_m2_s2=0.0,
    acceleration_m_s2=np.zeros(3),
    force_at_target_n=0.0,
    force_away_n=0.0,
    action=np.zeros(7),
    previous_action=np.zeros(7),
    turn_speed_rad_s=0.0,
    force_squared_n2=0.0,
    outcome=StepOutcome(),
    undelivered=True,
)


def test_every_column_has_its_place() -> None:
    assert tuple(STILL.signals()) == SIGNALS
    assert tuple(STILL.costs()) == COSTS


def signal(name: str, **changes: object) -> float:
    return replace(STILL, **changes).signals()[name]  # type: ignore[arg-type]


def cost(name: str, **changes: object) -> float:
    return replace(STILL, **changes).costs()[name]  # type: ignore[arg-type]


def place(*position: float) -> np.ndarray:
    return np.array(position)


def test_distance_is_from_the_tool_to_the_target() -> None:
    assert cost("C_d") == signal("distance_m") == pytest.approx(0.4)


def test_speed_is_a_cost_as_measured() -> None:
    assert cost("C_v", speed_m_s=0.3) == signal("speed_m_s", speed_m_s=0.3) == pytest.approx(0.3)


@pytest.mark.parametrize(("distance", "expected"), [(0.21, 0.0), (0.19, 0.09)])
def test_speed_counts_as_near_within_twenty_centimetres(distance: float, expected: float) -> None:
    near = signal("near_speed_squared_m2_s2", tool_m=place(0, -distance, 1.2), speed_squared_m2_s2=0.09)
    assert near == pytest.approx(expected)


@pytest.mark.parametrize(("force", "expected"), [(9.9, 0.0), (10.0, 10.0), (25.0, 25.0)])
def test_force_at_the_target_is_high_from_ten_newtons(force: float, expected: float) -> None:
    assert cost("C_hf", force_at_target_n=force) == signal("high_force_n", force_at_target_n=force) == expected


def test_force_away_from_the_target_is_the_force_cost() -> None:
    assert cost("C_f", force_away_n=3.0, force_at_target_n=20.0) == 3.0


def test_food_on_the_person_and_intake_speed_are_costs() -> None:
    assert cost("C_fd", outcome=StepOutcome(on_person=2)) == 2.0
    assert cost("C_fdv", outcome=StepOutcome(delivered=1, intake_speed_m_s=0.5)) == 0.5


@pytest.mark.parametrize(
    ("position", "expected"),
    [((0, -0.3, 1.2), 0.08), ((0, -0.3, 1.3), 0.18), ((0, -0.3, 1.1), 0.0), ((0, -0.05, 1.22), 0.0)],
)
def test_height_counts_from_eight_centimetres_below_the_target_until_close(
    position: tuple[float, ...], expected: float
) -> None:
    assert signal("height_above_target_m", tool_m=place(*position)) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("position", "expected"), [((0, -0.2, 1.2), 0.0), ((0.1, -0.2, 1.2), 0.1), ((0.1, -0.4, 1.2), 0.0)]
)
def test_sideways_offset_is_from_the_axis_out_of_the_target_and_only_near(
    position: tuple[float, ...], expected: float
) -> None:
    assert signal("lateral_offset_m", tool_m=place(*position)) == pytest.approx(expected, abs=1e-6)


def test_tilt_is_the_angle_from_level() -> None:
    assert signal("tilt_rad") == 0.0
    half = math.sqrt(0.5)
    assert signal("tilt_rad", tool_up=place(half, 0, half)) == pytest.approx(math.pi / 4)


def test_acceleration_and_action_change_are_squared() -> None:
    assert signal("acceleration_squared_m2_s4", acceleration_m_s2=place(3, 4, 0)) == pytest.approx(25.0)
    change = signal("action_change_squared", action=np.full(7, 0.5), previous_action=np.full(7, -0.5))
    assert change == pytest.approx(1.0)


def test_turning_strokes_and_the_square_of_the_force_are_signals() -> None:
    assert signal("turn_speed_squared_rad2_s2", turn_speed_rad_s=3.0) == 9.0
    assert signal("strokes", outcome=StepOutcome(strokes=2)) == 2.0
    assert signal("force_squared_n2", force_at_target_n=2.0, force_squared_n2=5.0) == 5.0


def test_undelivered_is_one_until_the_task_has_succeeded() -> None:
    assert (signal("undelivered"), signal("undelivered", undelivered=False)) == (1.0, 0.0)


def test_the_task_reward_adds_up() -> None:
    half = math.sqrt(0.5)
    step = replace(
        STILL,
        tool_up=place(half, 0, half),
        speed_m_s=0.2,
        force_at_target_n=1.0,
        force_away_n=3.0,
        action=np.array([0.6, 0.8, 0, 0, 0, 0, 0]),
        outcome=StepOutcome(delivered=3, spilled=2, strokes=4),
    )
    by_hand = -0.4 - 0.01 + 6.0 - 2.0 + 2.0 - 0.05 * 0.2 - 0.03 * 4.0 - 0.3 * (1 - half)
    reward = TaskReward(per_delivered=2.0, per_spilled=-1.0, per_stroke=0.5, tilt=-0.3)
    assert reward(step) == pytest.approx(by_hand)


def one_step(**values: float) -> tuple[np.ndarray, np.ndarray]:
    costs, signals = np.zeros((1, len(COSTS)), np.float32), np.zeros((1, len(SIGNALS)), np.float32)
    for name, value in values.items():
        if name in COSTS:
            costs[0, COSTS.index(name)] = value
        else:
            signals[0, SIGNALS.index(name)] = value
    return costs, signals


def test_the_papers_preference_reward_is_the_benchmarks_weighted_sum() -> None:
    costs, signals = one_step(C_d=0.4, C_v=0.2, C_f=10.0, C_hf=20.0, C_fd=2.0, C_fdv=0.5)
    by_hand = -(0.4 + 0.25 * 0.2 + 0.01 * 10 + 0.05 * 20 + 2.0 + 0.5)
    assert preference_rewards(FEEDING, costs, signals, form="paper")[0] == pytest.approx(by_hand)


def test_the_calibrated_form_charges_speed_squared() -> None:
    costs, signals = one_step(C_v=0.4, speed_squared_m2_s2=0.16)
    assert cost_items(FEEDING, costs, signals, "calibrated")[0, 1] == pytest.approx(0.8)
    assert preference_rewards(FEEDING, costs, signals)[0] == pytest.approx(-FEEDING.calibrated_speed_weight * 0.8)


def test_strokes_are_the_service_and_only_the_approach_to_an_itch_is_charged_for_its_speed() -> None:
    away = one_step(C_v=0.4, speed_squared_m2_s2=0.16)
    strokes = one_step(C_v=0.4, speed_squared_m2_s2=0.16, near_speed_squared_m2_s2=0.16)
    assert cost_items(SCRATCHING, *away, "calibrated")[0, 1] == pytest.approx(0.8)
    assert cost_items(SCRATCHING, *strokes, "calibrated")[0, 1] == 0.0
    assert cost_items(FEEDING, *strokes, "calibrated")[0, 1] == pytest.approx(0.8)
    assert cost_items(SCRATCHING, *strokes, "paper")[0, 1] == pytest.approx(0.4)


def test_the_calibrated_form_counts_eighths_of_the_portion_however_many_pieces_it_has() -> None:
    costs, signals = one_step(C_fd=4.0, C_fdv=8.0)
    finer = replace(FEEDING, pieces=32)
    assert cost_items(finer, costs, signals, "calibrated")[0, 4:].tolist() == [1.0, 2.0]
    assert cost_items(finer, costs, signals, "paper")[0, 4:].tolist() == [4.0, 8.0]
    assert cost_items(FEEDING, costs, signals, "calibrated")[0, 4:].tolist() == [4.0, 8.0]


def test_both_forms_differ_only_in_speed() -> None:
    rng = np.random.default_rng(0)
    costs, signals = rng.random((5, 6)), rng.random((5, len(SIGNALS)))
    paper, calibrated = (cost_items(FEEDING, costs, signals, form) for form in ("paper", "calibrated"))  # type: ignore[arg-type]
    others = [index for index, name in enumerate(COSTS) if name != "C_v"]
    np.testing.assert_array_equal(paper[:, others], calibrated[:, others])
    assert (base_weights(FEEDING, "paper")[others] == base_weights(FEEDING, "calibrated")[others]).all()


def test_omega_scales_one_items_share() -> None:
    costs, signals = one_step(C_d=0.4, C_fd=1.0)
    omega = [1, 1, 1, 1, 5, 1]
    assert preference_rewards(FEEDING, costs, signals, omega, "paper")[0] == pytest.approx(-5.4)


def test_a_persons_reward_is_linear_in_the_measured_signals() -> None:
    signals = replace(STILL, force_away_n=3.0, speed_squared_m2_s2=0.2, target_m=np.array([0.3, 0.0, 1.2])).signals()
    costs = replace(STILL, force_away_n=3.0, speed_squared_m2_s2=0.2, target_m=np.array([0.3, 0.0, 1.2])).costs()
    omega, more = [1, 3, 2, 1, 1, 5], {"tilt_rad": 0.3, "lateral_offset_m": -2.0}
    for task in (FEEDING, replace(FEEDING, pieces=32), SCRATCHING):
        measured = np.array([list(signals.values())])
        paid = preference_rewards(task, np.array([list(costs.values())]), measured, omega, per_signal=more)
        assert measured @ signal_weights(task, omega, more) == pytest.approx(paid)


def test_what_is_at_stake_counts_likes_and_dislikes_alike() -> None:
    costs, signals = one_step(C_d=0.4, C_fd=1.0, lateral_offset_m=0.1)
    minds = stakes(FEEDING, costs, signals, form="paper")
    assert minds == pytest.approx(-preference_rewards(FEEDING, costs, signals, form="paper"))
    likes = {"lateral_offset_m": -8.0}
    assert stakes(FEEDING, costs, signals, form="paper", per_signal=likes)[0] == pytest.approx(1.4 + 0.8)
