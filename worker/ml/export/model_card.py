"""The model card of a bundle: what the filter is, what was measured, and what must not be concluded from it."""

from collections.abc import Mapping, Sequence
from typing import Any

_COSTS = {
    "C_d": "distance of the tool from its target, m",
    "C_v": "speed of the tool, m/s",
    "C_f": "force on the person away from the target, N",
    "C_hf": "high force at the target, N",
    "C_fd": "pieces of food or water spilled on the person",
    "C_fdv": "speed of food or water entering the mouth, m/s",
}
_METHODS = {
    "studio": "the studio's: a personal execution mode with a residual action encoder around it, each kept only as far "
    "as it kept the task on held-out scenarios",
    "refined": "the studio's: a policy refined by reinforcement learning, for this person or beforehand for people who "
    "mind one thing, kept only as far as it kept the task on held-out scenarios",
    "printed": "PbARL as printed in the paper, with the readings stated in the project's docs/method.md; not gated",
}
_REWARDS = {
    "structured": "linear in the measured signals",
    "predicted": "linear in the signals; those that need sensors on the person are predicted from observation and "
    "action by a network in the same file",
    "mlp": "an ensemble of networks on observation and action",
    "preference_transformer": "an ensemble of Preference Transformers",
}

_USE = """## Use

```
python -m pip install numpy onnxruntime
python run_filter.py
```

The second command checks every file, runs the filter over `recorded/` and compares its actions with the recorded ones.
Your own recording: `python run_filter.py --observations o.npy --output a.npy`.
In a control loop, at every control step: `policy.onnx` turns the observation into the reference policy's mean action,
and `filter.onnx` turns both into the action to execute.
`manifest.json` lists every number with its unit and range; {units}."""
_AS_OURS = "all are SI units in the robot's base frame"
_AS_A_LABS = "units and frame are those of the laboratory's own environment (`interface` in the manifest)"

_LIMITS = """## Limits

* Measured in simulation{simulated}. Nothing here was run on a robot.
* The intervals cover the choice of scenarios. They do not cover a second training, other labels, or other bodies.
* "Preference" is the return of a model learned from this person's own labels, not their satisfaction.
* The largest speeds and forces are what happened in these simulated scenarios. They are not guaranteed bounds: keep the
  robot's own limits on speed and force, and an emergency stop within reach.
* A robot that acts later or sees less exactly than the simulated one may press harder and fail more often: measure its
  delay first. A loop (`run_filter.py --serve`) tells within seconds when what is seen follows from actions otherwise.
* The filter belongs to one reference policy (`policy` in the manifest) and one person."""


def model_card(manifest: Mapping[str, Any]) -> str:
    """Markdown, from the manifest."""
    sections = [
        _what(manifest),
        _choice(manifest.get("choice")),
        _REFERENCE if manifest.get("uses_reference_policy") else _way(manifest),
        _promise(manifest),
        _shield(manifest),
        _matters(manifest),
        _measured(manifest.get("evaluation")),
        _notes(manifest),
        _USE.format(units=_AS_A_LABS if _is_a_labs(manifest) else _AS_OURS),
        _elsewhere(manifest),
        _LIMITS.format(simulated="" if _is_a_labs(manifest) else ", with a model of one arm and one seated person"),
    ]
    return "\n\n".join(section for section in sections if section) + "\n"


_REFERENCE = """## This is the reference policy

**The filter in this bundle changes nothing: every action is the reference policy's own.** Nothing that was learned from
this person's comparisons was surely better for them without a price in success, force, speed or spills; the notes say
what was tried."""


def _is_a_labs(manifest: Mapping[str, Any]) -> bool:
    interface = manifest.get("interface") or {}
    return bool(interface.get("adds_previous_action_and_share"))


def _elsewhere(manifest: Mapping[str, Any]) -> str:
    """Where the policy is, if it is not in the bundle."""
    if manifest["policy"]["file"]:
        return ""
    function = manifest["interface"]["policy"].get("function")
    where = f"is the function `{function}`" if function else "answers from a server"
    return (
        f"The policy of this bundle {where}, so `policy.onnx` is not part of it:\n\n"
        "```\npython -m pip install websockets msgpack\n"
        f"python run_filter.py --serve 8001 --upstream {function or 'ws://HOST:PORT'}\n```"
    )


def _what(manifest: Mapping[str, Any]) -> str:
    labels, method = manifest["labels"], "refined" if manifest.get("refined") else manifest["method"]
    return (
        f"# Personal action filter: {manifest['participant']}, version {manifest['version']}\n\n"
        f"What runs after the frozen {manifest['task']} policy so that the robot does the task the way this person"
        f" prefers."
        f" Learned from {labels['count']} comparisons of two clips (study {manifest['study']}, seed {manifest['seed']},"
        f" labels sha256 `{labels['sha256'][:12]}`), exported {manifest['created_at']}.\n\n"
        f"Method: {_METHODS[method]}. Reward model: {_REWARDS[manifest['reward_kind']]}."
        f" Control rate: {manifest['control_rate_hz']:g} Hz."
    )


def _choice(choice: Mapping[str, Any] | None) -> str:
    """Which of several policies it is, and how surely."""
    if not choice:
        return ""
    chances = sorted(choice["chances"].items(), key=lambda each: -each[1])
    clear = "" if choice["sure"] else " **That is not clear: other policies may suit this person as well or better.**"
    return "\n".join(
        [
            "## The choice",
            "",
            f"Of {len(chances)} policies **{choice['policy']}** was chosen for this person, and is the policy of this "
            f"bundle; the filter leaves its actions as they are.{clear}",
            "",
            "| policy | chance of being the best |",
            "|---|---|",
            *(f"| {name} | {chance:.0%} |" for name, chance in chances),
            "",
            "Of those that keep the task; from the reward model's posterior, over held-out scenarios.",
        ]
    )


def _way(manifest: Mapping[str, Any]) -> str:
    """The person's mode in words."""
    if manifest["method"] != "studio" or manifest.get("choice"):
        return ""
    heading, mode = f"## This person's way\n\nGate {manifest['gate']:.0%}, ", manifest["mode"]
    if manifest.get("refined"):
        mode = manifest.get("refined_mode")
        if not mode:
            return f"{heading}a refined policy instead of a mode and a residual."
        heading += "a refined policy, executed in this mode."
    else:
        heading += f"residual {manifest['residual_share']:.0%}."
    rows = [
        f"| {axis['name']} | {mode.get(axis['name'], 0.0):+.2f} | {axis['low']:g} to {axis['high']:g} "
        f"| {axis['meaning']} |"
        for axis in manifest["mode_axes"]
    ]
    return "\n".join([heading, "", "| axis | value | range | meaning |", "|---|---|---|---|", *rows])


def _promise(manifest: Mapping[str, Any]) -> str:
    """What is promised about harm."""
    promise = manifest.get("promise")
    said = promise["sentence"] if promise else "Nothing is promised of this filter: it was not tested for harm."
    return f"## Promise about harm\n\n{said} Scenarios are those of the simulation, not of a real room."


_STEPS_NEAR_PERSON = {
    "deepest_m": "strike the skin harder than the reference policy usually touches it",
    "beside_target": "come much nearer to the skin beside the target than the reference policy's would",
}
"""What a step is kept from, by the limit in the manifest."""
_NO_BLOWS = "Near the person a step that is foreseen to {} loses what of it leads there; not every blow is foreseen."


def _shield(manifest: Mapping[str, Any]) -> str:
    """What the filter does outside what was tested."""
    shield = manifest.get("shield")
    if not shield:
        return ""
    active = shield["active_share"]
    measured = "" if active is None else f" On the unseen scenarios it was active in {active:.1%} of the control steps."
    limits = shield["limits"].get("step_near_person", {})
    kept_from = " or ".join(said for name, said in _STEPS_NEAR_PERSON.items() if name in limits)
    no_blows = f" {_NO_BLOWS.format(kept_from)}" if kept_from else ""
    return (
        "## Shield\n\nWhere observation, force, or the change of the action leave what was tested, the action returns"
        f" smoothly to the reference policy's.{no_blows} How far is the"
        f" graph's output `shield`, from 0 (not at all) to 1; the limits are in the manifest.{measured}"
    )


def _matters(manifest: Mapping[str, Any]) -> str:
    """The six costs, and the measured signals about which the labels say something."""
    parts = [_costs(manifest.get("learned_costs")), _signals(manifest.get("learned_weights"))]
    said = [part for part in parts if part]
    return "\n\n".join(["## What matters to this person", *said]) if said else ""


def _costs(learned: Mapping[str, Any] | None) -> str:
    if not learned:
        return ""
    introduction = (
        "Change of the learned return of a clip, in standard deviations, when one of the paper's costs grows by one and"
        f" the others stay as they are; they account for {learned['explained']:.0%} of what was learned."
        " 95 % intervals; below 0: disliked."
    )
    rows = [(_cost(name), each) for name, each in learned["weights"].items()]
    return f"{introduction}\n\n{_weights('cost', rows)}"


def _signals(weights: Mapping[str, Mapping[str, float]] | None) -> str:
    if not weights:
        return ""
    introduction = (
        "Log odds of being preferred per standard deviation of a signal between two clips, the other signals being"
        " equal, with 95 % intervals; signals about which the labels are undecided are left out."
    )
    clear = [(name, each) for name, each in weights.items() if each["low"] > 0.0 or each["high"] < 0.0]
    if not clear:
        return f"{introduction} They are undecided about every single one: many go along with each other."
    return f"{introduction}\n\n{_weights('signal', clear)}"


def _weights(what: str, rows: Sequence[tuple[str, Mapping[str, float]]]) -> str:
    """A table, the strongest first."""
    ordered = sorted(rows, key=lambda row: -abs(row[1]["mean"]))
    lines = [f"| {name} | {each['mean']:+.2f} [{each['low']:+.2f}, {each['high']:+.2f}] |" for name, each in ordered]
    return "\n".join([f"| {what} | weight |", "|---|---|", *lines])


def _measured(evaluation: Mapping[str, Any] | None) -> str:
    if not evaluation:
        return "## Measured\n\nNothing has been measured about this filter."
    success, preference, safety = evaluation["success"], evaluation["preference"], evaluation.get("safety")
    lines = [
        "## Measured",
        "",
        f"On {evaluation['scenarios']} unseen scenarios, against the reference policy in the same scenarios;"
        " differences with 95 % intervals over scenarios.",
        "",
        f"* Success: {success['filter']:.1%} (reference {success['reference']:.1%}), difference"
        f" {100 * success['delta']:+.1f} points [{100 * success['low']:+.1f}, {100 * success['high']:+.1f}].",
        f"* Learned preference: {_interval(preference)} standard deviations of the reference's returns per episode.",
        "",
        "| cost, summed over an episode | reference | filter | difference |",
        "|---|---|---|---|",
    ]
    for name, cost in evaluation["costs"].items():
        row = f"| {_cost(name)} | {cost['reference']:.3g} | {cost['filter']:.3g} | {_interval(cost)} |"
        lines.append(row)
    if safety:
        lines += ["", "### Largest speeds and forces seen", "", "| | reference | filter |", "|---|---|---|"]
        words = {
            "max_speed_m_s": "largest speed, m/s",
            "p95_max_speed_m_s": "95 % of episodes stay below, m/s",
            "max_force_n": "largest force on the person, N",
            "p95_max_force_n": "95 % of episodes stay below, N",
        }
        for key, word in words.items():
            if key in safety["reference"]:
                lines.append(f"| {word} | {safety['reference'][key]:.3g} | {safety['filter'][key]:.3g} |")
    return "\n".join(lines)


def _cost(name: str) -> str:
    """One of the paper's with its meaning, or a laboratory's own by its name."""
    return f"{name}: {_COSTS[name]}" if name in _COSTS else name


def _notes(manifest: Mapping[str, Any]) -> str:
    if not manifest["notes"]:
        return ""
    return "## Notes\n\n" + "\n".join(f"* {note}" for note in manifest["notes"])


def _interval(change: Mapping[str, float]) -> str:
    return f"{change['delta']:+.3g} [{change['low']:+.3g}, {change['high']:+.3g}]"
