"""The words for each task. The worker stores names of axes and signals; what they mean to people is said here."""

from collections.abc import Mapping
from dataclasses import dataclass

from app.domain.studies import TaskName


@dataclass(frozen=True)
class TaskWords:
    """What pages call a task and its parts. A name without a word is shown plainly, so asking for it is no error."""

    title: str
    summary: str
    """One sentence for the person who chooses a task."""
    costs: Mapping[str, str]
    """The paper's preference costs, by symbol; only those that can differ from 0 in this task."""
    axes: Mapping[str, str]
    """The ways in which executions differ; the sign says which end."""
    signals: Mapping[str, str]
    """What the structured reward model weighs."""
    silent_signals: frozenset[str] = frozenset()
    """Always 0 in this task; a weight of them says nothing."""


def words_of(task: str) -> TaskWords:
    """The words of a task; for one that this version does not know, its name and neutral words."""
    if task in set(TaskName):
        return _WORDS[TaskName(task)]
    title = task.replace("_", " ").capitalize()
    return TaskWords(title, "", _costs("tool", "target", "Food or water"), axes={}, signals={})


def _costs(tool: str, target: str, portion: str | None = None) -> Mapping[str, str]:
    costs = {
        "C_d": f"Distance from the {target}",
        "C_v": f"Speed of the {tool}",
        "C_f": f"Force away from the {target}",
        "C_hf": f"High force at the {target}",
    }
    if portion is not None:
        costs |= {"C_fd": f"{portion} spilled on the person", "C_fdv": f"{portion} entering fast"}
    return costs


def _approach(target: str) -> Mapping[str, str]:
    return {
        "speed_far": f"far from the {target}: slower (\N{MINUS SIGN}), quicker (+)",
        "speed_near": f"near the {target}: slower (\N{MINUS SIGN}), quicker (+)",
        "from_below": "comes from above (\N{MINUS SIGN}), below (+)",
        "to_side": "comes round the person\N{RIGHT SINGLE QUOTATION MARK}s right (\N{MINUS SIGN}), left (+)",
        "hesitate": f"waits before the {target} (+)",
    }


def _signals(tool: str, target: str, portion: str = "food") -> Mapping[str, str]:
    return {
        "distance_m": f"distance from the {target} (m)",
        "speed_m_s": f"{tool} speed (m/s)",
        "speed_squared_m2_s2": f"{tool} speed squared (m²/s²)",
        "acceleration_squared_m2_s4": f"{tool} acceleration squared (m²/s⁴)",
        "near_speed_squared_m2_s2": f"speed squared near the {target} (m²/s²)",
        "force_at_target_n": f"force at the {target} (N)",
        "force_away_n": f"force away from the {target} (N)",
        "high_force_n": f"high force at the {target} (N)",
        "force_squared_n2": f"force squared at the {target} (N²)",
        "spilled_on_person": f"{portion} spilled on the person",
        "spilled": f"{portion} spilled anywhere",
        "intake_speed_m_s": f"speed of the {portion} entering (m/s)",
        "height_above_target_m": f"height above the {target} (m)",
        "lateral_offset_m": f"{tool} to one side of the {target} (m)",
        "tilt_rad": f"tilt of the {tool} (rad)",
        "turn_speed_squared_rad2_s2": f"turning of the {tool}, squared (rad²/s²)",
        "undelivered": "task not finished yet",
        "action_change_squared": "jerkiness of the arm",
        "strokes": "strokes over the itch",
    }


_WORDS: Mapping[TaskName, TaskWords] = {
    TaskName.FEEDING: TaskWords(
        "Feeding",
        "A spoon with eight pieces of food is brought to the mouth.",
        _costs("spoon", "mouth", "Food"),
        {**_approach("mouth"), "press": "goes into the mouth less (\N{MINUS SIGN}), deeper (+)"},
        _signals("spoon", "mouth"),
        frozenset({"strokes"}),
    ),
    TaskName.DRINKING: TaskWords(
        "Drinking",
        "A cup of water is brought to the mouth and tipped.",
        _costs("cup", "mouth", "Water"),
        {
            **_approach("mouth"),
            "tip_early": "tipped on the way less (\N{MINUS SIGN}), more (+)",
            "pour_angle": "tipped at the mouth less (\N{MINUS SIGN}), more (+)",
            "pour_haste": "pours slower (\N{MINUS SIGN}), quicker (+)",
        },
        _signals("cup", "mouth", "water"),
        frozenset({"strokes"}),
    ),
    TaskName.SCRATCHING: TaskWords(
        "Itch scratching",
        "A scratcher gently strokes an itch on the right arm.",
        _costs("scratcher", "itch"),
        {
            **_approach("itch"),
            "to_side": "comes round one side of the itch (\N{MINUS SIGN}), the other (+)",
            "press": "presses gently (\N{MINUS SIGN}), firmly (+)",
            "stroke_speed": "strokes calmly (\N{MINUS SIGN}), briskly (+)",
        },
        _signals("scratcher", "itch"),
        frozenset({"spilled_on_person", "spilled", "intake_speed_m_s"}),
    ),
}
