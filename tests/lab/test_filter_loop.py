"""A filter as a loop between a client and a policy, in one process: what it answers, and what it refuses or tells."""

import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.lab.filtered_plane import Plane, unshielded
from tests.lab.policy_server import serving, to_goal
from tests.lab.test_check import change
from tests.worker import invented
from worker.compute import filter_finishing
from worker.domain.type_aliases import Float32Array
from worker.ml.export import filter_loop
from worker.ml.export.filter_loop import FilterLoop, Refused, require_same
from worker.ml.export.forward_model import ForwardModel
from worker.ml.export.interface import interface_of
from worker.ml.filters.exported import shield
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.policies.policy_client import packed

SEEN = {"observation": np.array([0.1, 0.2, 0.8, -0.6], np.float32)}


def of(answer: dict[str, Any]) -> tuple[str, list[float]]:
    return answer["filter"]["state"], np.round(answer["actions"][0], 6).tolist()


@pytest.mark.parametrize("moving", ["[0, 1]", "[1]"])
def test_the_loop_acts_as_the_studio_did_when_the_filter_was_fitted(
    plane: Path, plane_of: Callable[..., Plane], moving: str
) -> None:
    change(plane, "rate_hz = 10", f"rate_hz = 10\nmoving = {moving}")
    made = plane_of()
    trajectory = made.environment.episode(made.filter, 3)
    loop = made.loop()
    said = [loop.answer(packed({"observation": seen[:4]})) for seen in trajectory.observations[:-1]]
    in_its_own_unit = 0.1 * trajectory.actions
    np.testing.assert_allclose([each["actions"][0] for each in said], in_its_own_unit, atol=1e-6)
    assert {each["filter"]["state"] for each in said} == {"ok"}
    assert said[0]["server_timing"] == {"infer_ms": 0.1}, "what else the policy says is passed on"
    again = loop.answer(packed({"observation": trajectory.observations[0, :4], "reset": True}))
    np.testing.assert_allclose(again["actions"][0], in_its_own_unit[0], atol=1e-6)
    loop.close()


def test_a_late_policy_slows_the_robot_and_then_stops_it_until_it_is_in_time(plane_of: Callable[..., Plane]) -> None:
    free = threading.Event()
    free.set()

    def answer(message: dict[str, Any]) -> dict[str, Any]:
        free.wait()
        return {"actions": to_goal(message)["actions"][:1]}

    loop = plane_of(answer).loop(deadline_s=0.05)
    state, first = of(loop.answer(packed(SEEN)))
    assert state == "ok"
    free.clear()
    states, actions = zip(*(of(loop.answer(packed(SEEN))) for _ in range(5)), strict=True)
    assert states == ("slow", "slow", "slow", "stop", "stop")
    np.testing.assert_allclose(actions, np.outer([0.5, 0.25, 0.125, 0.0, 0.0], first), atol=1e-6)
    free.set()
    loop._deadline_s = 5.0
    assert of(loop.answer(packed(SEEN)))[0] == "ok"
    assert loop.counted.states == {"ok": 2, "slow": 3, "stop": 2}
    loop.close()


@pytest.mark.parametrize(
    ("broken", "why"),
    [
        ("Traceback: out of memory", "out of memory"),
        ({"actions": np.full((1, 2), np.nan)}, "NaN"),
        ({"actions": np.zeros((1, 7))}, "the shape (1, 7), and (H, 2) is needed"),
        (b"\xc1", "not understood"),
    ],
)
def test_what_is_no_action_stops_the_robot_at_once_and_it_goes_on_when_the_policy_does(
    plane_of: Callable[..., Plane], broken: Any, why: str
) -> None:
    answers = iter([None, broken, None])

    def answer(message: dict[str, Any]) -> Any:
        return next(answers) or {"actions": to_goal(message)["actions"][:1]}

    loop = plane_of(answer).loop()
    said = [loop.answer(packed(SEEN)) for _ in range(3)]
    assert [each["filter"]["state"] for each in said] == ["ok", "stop", "ok"]
    assert not said[1]["actions"].any()
    assert why in said[1]["filter"]["why"]
    loop.close()


def test_a_policy_server_that_is_gone_stops_the_robot_until_it_is_back(plane: Path) -> None:
    with serving(lambda message: {"actions": to_goal(message)["actions"][:1]}) as url:
        made = Plane(plane, url)
        loop = made.loop()
        assert of(loop.answer(packed(SEEN)))[0] == "ok"
    gone = [loop.answer(packed(SEEN)) for _ in range(2)]
    assert [of(each) for each in gone] == [("stop", [0.0, 0.0])] * 2
    assert "no policy server answers" in gone[1]["filter"]["why"]
    with serving(port=int(url.rpartition(":")[2])):
        assert of(loop.answer(packed(SEEN)))[0] == "ok"
    loop.close()


def test_a_client_that_was_silent_goes_on_from_standstill_with_a_new_chunk(plane_of: Callable[..., Plane]) -> None:
    asked: list[int] = []

    def answer(message: dict[str, Any]) -> dict[str, Any]:
        asked.append(1)
        return to_goal(message)

    made = plane_of(answer)
    for pause_s, chunks in ((60.0, 1), (1e-9, 4)):  # any silence is longer than that
        asked.clear()
        loop = made.loop(pause_s=pause_s)
        said = [loop.answer(packed(SEEN)) for _ in range(4)]
        assert len(asked) == chunks
        assert {each["filter"]["state"] for each in said} == {"ok"}
        assert loop.counted.pauses == chunks - 1
        loop.close()


def test_a_client_that_waits_for_a_slow_policy_is_not_silent(
    plane_of: Callable[..., Plane], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, clock = list[int](), [0.0]

    def answer(message: dict[str, Any]) -> dict[str, Any]:
        asked.append(1)
        clock[0] += 2.0
        return to_goal(message)

    made = plane_of(answer)
    monkeypatch.setattr(filter_loop, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    loop = made.loop(pause_s=1.0)
    for _ in range(4):
        loop.answer(packed(SEEN))
    assert (len(asked), loop.counted.pauses) == (1, 0), "the actions of its chunk are used, however long it took"
    loop.close()


@pytest.mark.parametrize(
    ("message", "sentence"),
    [
        (b"\xc1", "the message cannot be read"),
        (
            {"image": np.zeros(3)},
            "the message has image; this filter needs observation (4 x as the environment has it)",
        ),
        ({"observation": np.zeros(5)}, "observation has the shape (5,); this filter needs (4,)"),
        ({"observation": "here"}, "observation is no array of numbers"),
        ({"observation": np.full(4, np.nan)}, "observation holds a NaN"),
        ({"observation": np.full(4, 500.0)}, "far outside [-2, 2]. This bundle belongs to the unit"),
        (SEEN | {"interface": {"control_rate_hz": 50.0}}, "control_rate_hz 50.0; this bundle belongs to 10.0"),
        (
            SEEN | {"interface": {"frame": "tool"}},
            "the client is of frame tool; this bundle belongs to the environment's",
        ),
        (SEEN | {"interface": {"task": "reach"}}, "of task reach; this bundle belongs to plane"),
        (SEEN | {"interface": {"units": {"observation": "mm"}}}, "says observation in mm; this bundle belongs to as"),
    ],
)
def test_what_a_bundle_does_not_belong_to_is_refused_in_a_sentence(
    plane_of: Callable[..., Plane], message: Any, sentence: str
) -> None:
    loop = plane_of().loop()
    with pytest.raises(Refused) as refused:
        loop.answer(message if isinstance(message, bytes) else packed(message))
    assert sentence in str(refused.value)
    loop.close()


def test_a_bundle_of_ours_says_units_frame_and_rate_and_takes_its_fields_by_name() -> None:
    policy = invented.small_policy()
    interface = interface_of(invented.TASK, policy)
    assert (interface["frame"], interface["control_rate_hz"]) == ("robot base", 10.0)
    require_same("somebody", interface | {"units": {"tool_position_m": "m", "action": "1"}}, interface)
    with pytest.raises(Refused, match="says tool_position_m in mm; this bundle belongs to m"):
        require_same("somebody", {"units": {"tool_position_m": "mm"}}, interface)
    with pytest.raises(Refused, match="is of fingerprint"):
        require_same("somebody", {"fingerprint": "00"}, interface)
    act = act_of(invented.TASK.modes, policy, FilterWeights(mode={"speed_near": -0.5}))
    loop = FilterLoop(interface, unshielded(act), policy.mean, 5.0, 60.0)
    seen = np.zeros(invented.TASK.observation.size, np.float32) + 0.1
    parts = {field.name: seen[place] for field, place in invented.TASK.observation.slices()}
    tables = {name: part.reshape(1, -1, 1) for name, part in parts.items()}
    for message in ({"observation": seen}, parts, tables):
        np.testing.assert_allclose(loop.answer(packed(message))["actions"][0], act(seen), atol=1e-6)
    with pytest.raises(Refused, match=r"tool_position_m is .* look at units and frame"):
        loop.answer(packed(parts | {"tool_position_m": np.full(3, 500.0)}))
    loop.close()


def test_a_shield_that_acts_more_than_in_tests_is_told_once_an_episode_has_been_seen() -> None:
    policy, size = invented.small_policy(), invented.TASK.observation.size
    limits = shield.widest(invented.TASK.observation, policy.action_size)
    limits["observation_high"][0], limits["observation_ramp"][0] = 0.5, 1.0
    act = act_of(invented.TASK.modes, policy, FilterWeights(mode={"speed_near": -0.5}, shield=limits))
    interface = interface_of(invented.TASK, policy)
    loop = FilterLoop(interface, act.exported.run, policy.mean, 5.0, 60.0)
    loop.usual_strong_share = 0.2

    def episode(first: float) -> list[dict[str, Any]]:
        seen = np.full(size, 0.1, np.float32)
        seen[0] = first
        return [loop.answer(packed({"observation": seen}))["filter"] for _ in range(interface["episode_steps"])]

    def tells(said: dict[str, Any]) -> bool:
        return "the steps the shield takes back a quarter or more of what the filter does" in said["why"]

    for first, slightly in ((0.1, False), (0.6, True)):
        said = episode(first)
        assert {(0.0 < each["shield"] < 0.05, tells(each)) for each in said} == {(slightly, False)}
    said = episode(1.5)
    assert {each["shield"] for each in said} == {1.0}
    told = [tells(each) for each in said]
    assert told.index(True) == 0.2 * len(said)
    assert all(told[told.index(True) :])
    assert "in 100% of the steps the shield" in said[-1]["why"]
    assert "shield" in said[-1]["unlike_tests"]
    assert f"the shield active in {2 * len(said)}" in str(loop.counted)
    loop.begin_connection()
    assert not any(tells(each) for each in episode(1.5)[:-1])
    loop.close()


def forward_model(made: Plane) -> ForwardModel:
    """Of its usual episodes, as the studio learns it of an evaluation's."""
    driven = [made.environment.episode(made.filter, scenario, made.policy.mean) for scenario in range(12)]
    found = filter_finishing.forward_model_of(made.task, driven)
    assert found is not None
    return found


def test_a_robot_whose_actions_come_late_is_told_before_its_episode_ends(
    plane_of: Callable[..., Plane], tmp_path: Path
) -> None:
    made = plane_of()
    (tmp_path / "forward_model.npz").write_bytes(forward_model(made).to_bytes())
    loop = made.loop()
    loop.compare_with_tests({}, tmp_path)

    def episode(late: int) -> list[bool]:
        """Whether it is told, step by step."""
        on_the_way, told = deque([np.zeros(2, np.float32)] * late), list[bool]()

        def act(seen: Float32Array) -> Float32Array:
            answer = loop.answer(packed({"observation": seen[:4]} | ({} if told else {"reset": True})))
            told.append("late" in answer["filter"]["unlike_tests"])
            on_the_way.append(np.asarray(answer["actions"][0], np.float32) / 0.1)
            return on_the_way.popleft()

        made.environment.episode(act, 50)
        return told

    assert not any(episode(late=0))
    assert episode(late=2).index(True) < 20
    assert not any(episode(late=0)), "an episode begins anew"
    assert f"late in {loop.counted.unlike_tests['late']}" in str(loop.counted)
    loop.close()


def test_an_environment_with_goals_has_a_field_called_observation_and_is_asked_by_fields_or_whole() -> None:
    policy = invented.small_policy()
    interface = interface_of(invented.TASK, policy)
    (first, place), *others = invented.TASK.observation.slices()
    fields = [interface["observation"][0] | {"name": "observation"}, *interface["observation"][1:]]
    inputs = {
        "observation": list(range(place.stop)),
        **{other.name: list(range(at.start, at.stop)) for other, at in others},
    }
    interface |= {"observation": fields, "policy": interface["policy"] | {"inputs": inputs}}
    loop = FilterLoop(interface, lambda seen, mean: (mean, np.zeros((1, 1))), policy.mean, 5.0, 60.0)
    seen = np.zeros(invented.TASK.observation.size, np.float32) + 0.1
    parts = {"observation": seen[place], **{other.name: seen[at] for other, at in others}}
    whole, by_fields = (loop.answer(packed(each))["actions"] for each in ({"observation": seen}, parts))
    np.testing.assert_array_equal(whole, by_fields)
    with pytest.raises(Refused, match=rf"observation has the shape .* needs \({first.size},\)"):
        loop.answer(packed(parts | {"observation": np.zeros(first.size + 1)}))
    loop.close()
