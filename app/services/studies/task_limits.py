"""What the task of a study does not allow, whatever else its settings are."""

from collections.abc import Mapping, Sequence
from http import HTTPStatus

from app.domain.choices import Method, RewardKind, Strategy
from app.domain.protocol import NEEDS_WEIGHTS, EvaluatedMethod, EvaluationMode
from app.domain.study_settings import StudySettings
from app.errors import AppError
from app.installed_tasks import catalogue
from app.installed_tasks.by_name import longest_clip_steps

_NEEDS_WEIGHTS = (
    "would need the policy's own weights, and this task's policy is only asked what it does. Choose something else."
)


class TaskCannot(AppError):
    """This study asks for something that its task does not allow."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


def require(task: str, settings: StudySettings, *, recorded: bool = False) -> None:
    """Raises TaskCannot, which says what has to be changed. ``recorded``: see complaints()."""
    found = complaints(task, settings, recorded=recorded)
    if found:
        raise TaskCannot(" ".join(found.values()))


def needing_a_simulator(settings: StudySettings) -> Sequence[str]:
    """Names of the settings that ask for what a study of recordings cannot have."""
    asked = {
        "evaluation": settings.evaluation is not None,
        "arms": bool(settings.arms),
        "debrief": settings.debrief,
        "catch_pairs": settings.catch_pairs > 0,
        "reward_kind": settings.reward_kind is not RewardKind.STRUCTURED,
        "pooled_prior": settings.pooled_prior,
        "strategy": settings.strategy is Strategy.CONTESTED,
        "following_share": settings.following_share > 0.0,
        "refinement_steps": settings.refinement_steps > 0,
    }
    return [name for name, is_asked in asked.items() if is_asked]


def complaints(task: str, settings: StudySettings, *, recorded: bool = False) -> Mapping[str, str]:
    """What is wrong, by the form's field; nothing of a task that is not installed here.

    ``recorded``: the study shows recordings, whatever its task is called.
    """
    if recorded:
        names = ", ".join(name.replace("_", " ") for name in needing_a_simulator(settings))
        return {"": f"A study of recordings has no simulator, which is needed for: {names}."} if names else {}
    found: dict[str, str] = {}
    longest = longest_clip_steps(task)
    if longest is not None and settings.clip_steps > longest:
        found["clip_steps"] = f"An episode of this task has {longest} steps. Enter at most as many."
    installed = catalogue.find(task)
    if installed is None:
        return found
    most = installed.description.most_behaviours
    if most is not None and settings.behaviours_per_scenario > most:
        found["behaviours_per_scenario"] = f"This task has {most} policies to choose from. Enter at most {most}."
    if most is not None and settings.following_share:
        found["following_share"] = "One of several policies is chosen in this task: nothing can be varied. Enter 0."
    if not installed.description.policy_is_looked_into:
        if settings.method is Method.PRINTED:
            found["method"] = f"PbARL as printed {_NEEDS_WEIGHTS}"
        if settings.reward_kind is RewardKind.PREDICTED:
            found["reward_kind"] = "The signals of this task cannot be foreseen. Choose another reward model."
        if settings.refinement_steps:
            found["refinement_steps"] = f"A refinement {_NEEDS_WEIGHTS.removesuffix('Choose something else.')}Enter 0."
    if settings.evaluation is None:
        return found
    asked = {*settings.evaluation.methods, *(method for arm in settings.arms for method in arm.methods)}
    in_need = [method.label for method in NEEDS_WEIGHTS if method in asked]
    if in_need and not installed.description.policy_is_looked_into:
        found["evaluation_methods"] = f"{' and '.join(in_need)} {_NEEDS_WEIGHTS}"
    if most is not None and EvaluatedMethod.SELF_SET in asked:
        found["evaluation_methods"] = "One of several policies is chosen in this task: nothing can be set by sliders."
    if not installed.description.policy_is_packed and settings.evaluation.mode is EvaluationMode.PHYSICAL:
        found["evaluation_mode"] = (
            "This task's policy is no file, so a robot cannot be packed for its operator. Show videos."
        )
    return found
