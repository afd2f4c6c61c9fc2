"""A policy behind a websocket: what the studio asks it, and what is said when it does not do what it must."""

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.lab.conftest import write_plane
from tests.lab.policy_server import serving, to_goal
from worker.compute import baseline_fitting, simulation
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act
from worker.experiments import fit_response_surface
from worker.experiments.check_lab import Checked, checked
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.policies import asked_policy
from worker.ml.policies.onnx_policy import NotAPolicy
from worker.ml.policies.policy_client import packed, unpacked
from worker.tasks import registry


@pytest.fixture(autouse=True)
def _as_a_new_process() -> Iterator[None]:
    yield
    asked_policy.forget()


def behind(folder: Path, url: str, more: str = "") -> Path:
    """The plane, with its policy at this address."""
    text = (
        (folder / "lab.toml")
        .read_text()
        .replace(
            "[instructions]",
            '[modes]\nleave_out = ["smooth", "hesitate", "push_x", "push_y", "speed_near"]\n[instructions]',
        )
    )
    (folder / "lab.toml").write_text(text.replace('file = "policy.onnx"', f'url = "{url}"\nanswer_s = 0.3\n{more}'))
    return folder


def found(folder: Path) -> Checked:
    return checked(folder / "lab.toml", folder / "sheet.png")


def test_a_policy_behind_a_websocket_does_what_it_would_from_a_file(plane: Path, use: Callable[[Path], None]) -> None:
    asked: list[dict[str, Any]] = []
    with serving(asked=asked) as url:
        remarks = found(behind(plane, url)).remarks
    assert remarks[0].startswith("3 of 3 episodes succeeded")
    assert set(asked[0]) == {"observation"}
    assert asked[0]["observation"].shape == (4,), "its own observation, without what the studio adds"


def test_a_chunk_is_executed_as_far_as_it_is_said_before_the_next_is_asked_for(plane: Path) -> None:
    asked: list[dict[str, Any]] = []
    more = 'execution_horizon = 4\nprompt = "to the goal"\ninputs = { "observation/state" = "[0:4]", goal = "[2:4]" }\n'

    def answer(message: dict[str, Any]) -> dict[str, Any]:
        assert message["prompt"] == "to the goal"
        assert message["goal"].tolist() == message["observation/state"][2:4].tolist()
        return to_goal({"observation": message["observation/state"]})

    with serving(answer, asked=asked) as url:
        assert found(behind(plane, url, more)).wrong == ()
    assert len(asked) == 2 + 3 * 40 / 4 + 2 * 5, "first twice, every fourth step of three episodes, five once more"


def never(_: dict[str, Any]) -> Any:
    return None


def hangs_up(_: dict[str, Any]) -> Any:
    raise ConnectionError


FIRST = iter(range(10**6))


@pytest.mark.parametrize(
    ("answer", "complaint"),
    [
        (never, "said nothing for 0.3 s. Look whether it hangs"),
        (hangs_up, "hung up"),
        (lambda _: "Traceback: KeyError: 'image'", "reports an error: Traceback: KeyError: 'image'"),
        (lambda _: b"\xc1", "sent what is not understood"),
        (lambda _: {"action": np.zeros((1, 2))}, "has no 'actions', only 'action'"),
        (lambda _: {"actions": np.zeros((4, 3))}, "have the shape (4, 3), and (H, 2) is needed"),
        (lambda _: {"actions": np.zeros((0, 2))}, "have the shape (0, 2), and (H, 2) is needed"),
        (lambda _: {"actions": "left"}, "are a str; send an array (H, 2)"),
        (lambda _: {"actions": np.full((1, 2), np.nan)}, "hold a NaN or an infinity"),
        (lambda _: {"actions": np.full((1, 2), 1e-4 * next(FIRST))}, "answered the same observation in two ways"),
    ],
)
def test_a_server_that_does_not_do_what_it_must_is_told_of_with_what_to_do(
    plane: Path, answer: Callable[[dict[str, Any]], Any], complaint: str
) -> None:
    with serving(answer) as url:
        (wrong,) = found(behind(plane, url)).wrong
    assert "policy.url: " in wrong
    assert complaint in wrong


@pytest.mark.parametrize(
    ("metadata", "complaint"),
    [("ready", "reports an error: ready"), (packed({}) + b"more", "It must send its metadata")],
)
def test_metadata_come_first(plane: Path, metadata: Any, complaint: str) -> None:
    with serving(metadata=metadata) as url:
        (wrong,) = found(behind(plane, url)).wrong
    assert complaint in wrong


def test_a_dead_server_and_one_of_something_else_are_told_apart(plane: Path, tmp_path: Path) -> None:
    with serving() as url:
        pass
    (wrong,) = found(behind(plane, url)).wrong
    assert f"no policy server answers at {url}" in wrong
    assert "Start it" in wrong


@pytest.mark.parametrize(
    ("more", "complaint"),
    [
        ('file = "policy.onnx"', "policy needs either file, url"),
        ("execution_horizon = 9", "answers with 4 actions, and policy.execution_horizon wants 9"),
        ('inputs = { state = "tip" }', "policy.inputs.\"state\": No field 'tip'"),
    ],
)
def test_a_mistake_about_it_in_the_file_is_told_with_its_key(plane: Path, more: str, complaint: str) -> None:
    with serving() as url:
        (wrong,) = found(behind(plane, url, more)).wrong
    assert complaint in wrong


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ('file = "policy.onnx"', 'url = "http://127.0.0.1"', "policy.url must be the address of a websocket"),
        ('file = "policy.onnx"', 'file = "policy.onnx"\nprompt = "go"', "prompt is for policy servers"),
    ],
)
def test_a_file_that_mixes_both_is_refused(plane: Path, before: str, after: str, complaint: str) -> None:
    text = (plane / "lab.toml").read_text()
    (plane / "lab.toml").write_text(text.replace(before, after))
    assert complaint in found(plane).wrong[0]


@pytest.mark.parametrize("dtype", ["|O", "O", "<M8", "|V4", "<U1", "<c8", "q" * 50])
def test_arrays_of_anything_but_numbers_are_refused_before_they_are_made(dtype: str) -> None:
    array = {b"__ndarray__": True, b"data": b"\0" * 8, b"dtype": dtype, b"shape": [1]}
    with pytest.raises(ValueError, match="instead of numbers"):
        unpacked(packed({"actions": array}))


@pytest.mark.parametrize("shape", [[3], [-1], [1 << 62], [True], ["1"], None])
def test_arrays_whose_shape_is_not_that_of_their_data_are_refused(shape: Any) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 -- NumPy's own words in some cases
        unpacked(packed({"a": {b"__ndarray__": True, b"data": b"\0" * 8, b"dtype": "<f8", b"shape": shape}}))


def test_messages_are_read_back_as_they_were(plane: Path) -> None:
    message = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.float64(1.5), "c": "word", "d": [True, None]}
    back = unpacked(packed(message))
    np.testing.assert_array_equal(back["a"], message["a"])
    assert back["a"].flags.writeable
    assert (back["b"], back["c"], back["d"]) == (1.5, "word", [True, None])


def test_another_policy_at_the_same_address_is_not_taken_for_the_one_that_was_explored(
    tmp_path: Path, use: Callable[[Path], None]
) -> None:
    with serving() as url:
        folder = behind(write_plane(tmp_path / "plane_lab"), url)
        use(folder)
        fit_response_surface.find_ranges("plane", scenarios=1)
        assert registry.task("plane").interface is not None
        assert simulation.run_episode("plane", simulation.reference_policy("plane").mean, 1).success
        port = int(url.rpartition(":")[2])
    asked_policy.forget()
    use(folder)
    with (
        serving(lambda message: {"actions": -to_goal(message)["actions"]}, port=port),
        pytest.raises(NotAPolicy, match="is not the one with which the task was explored"),
    ):
        simulation.run_episode("plane", simulation.reference_policy("plane").mean, 1)
    asked_policy.forget()
    with serving() as elsewhere:
        (folder / "lab.toml").write_text((folder / "lab.toml").read_text().replace(url, elsewhere))
        use(folder)
        policy = simulation.reference_policy("plane")
        assert simulation.run_episode("plane", policy.mean, 1).success, "the same policy at another address"


def test_a_server_that_was_started_again_is_asked_again(plane: Path, use: Callable[[Path], None]) -> None:
    with serving() as url:
        use(behind(plane, url))
        fit_response_surface.find_ranges("plane", scenarios=1)
        policy = simulation.reference_policy("plane")
        simulation.run_episode("plane", policy.mean, 1)
    with serving(port=int(url.rpartition(":")[2])):
        assert simulation.run_episode("plane", policy.mean, 2).success


def test_in_a_blinded_evaluation_a_robot_does_what_its_filter_does_to_what_the_server_says(
    plane: Path, use: Callable[[Path], None]
) -> None:
    with serving() as url:
        use(behind(plane, url))
        fit_response_surface.find_ranges("plane", scenarios=1)
        family, policy = registry.task("plane").modes, simulation.reference_policy("plane")
        weights = FilterWeights(mode=family.named([axis.low for axis in family.axes]))
        robots: list[tuple[Act, bytes]] = [
            (policy.mean, baseline_fitting.controller_of_reference("plane")),
            (act_of(family, policy, weights), baseline_fitting.controller_of_filter("plane", weights.to_bytes())),
        ]
        actions = []
        for act, controller in robots:
            filmed = simulation.film("plane", "quick", controller, 7)
            shown = Trajectory.load(io.BytesIO(filmed.trajectory))
            actions.append(np.asarray(shown.actions))
            np.testing.assert_allclose(
                actions[-1], np.asarray(simulation.run_episode("plane", act, 7).actions), atol=1e-6
            )
        assert np.abs(actions[0] - actions[1]).max() > 0.1
    assert len({len(controller) for _, controller in robots}) == 1, "its length tells nothing"
