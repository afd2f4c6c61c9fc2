"""The results part of a paper: every number of the stored report, with what could not be computed and why.

Of an unblinded study alone: before, a letter is another method for everybody.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from app.services.evaluation import unblinding
from app.services.paper.prose import (
    count,
    has_number,
    interval,
    number,
    p_value,
    paragraph,
    percent,
    share_interval,
    table,
)
from app.services.studies.preregistration import TEST_NAMES, Plan

Result = Mapping[str, Any]
ALPHA = "\N{GREEK SMALL LETTER ALPHA}"
RECOMMENDED = "paired_t"
"""In the text where nothing was planned; between arms Welch's."""


def results_part(contents: Result, plan: Plan) -> Iterator[str]:
    """Paragraphs in Markdown. ``contents``: of a report (worker/analysis/study/report.py) of an unblinded study."""
    yield "# Results"
    yield "## Answers and models"
    yield from _answers(contents["answers"])
    yield from _change(contents["change"])
    if contents["ratings"]["groups"]:
        yield "## Ratings"
        yield from _ratings(contents["ratings"], plan)
    if contents["head_to_heads"] is not None:
        yield "## Head-to-heads"
        yield from _head_to_heads(contents["head_to_heads"])
    if contents["guesses"] is not None:
        yield "## Which robot was made for them"
        yield _guesses(contents["guesses"])
    if contents["instruments"]:
        yield "## Questionnaires"
        yield from _instruments(contents["instruments"])


def name_of(group: str) -> str:
    """What a method is called in the text; the group of what is about no robot has no name."""
    return {method.value: name for method, name in unblinding.NAMES.items()}.get(group, group)


def _answers(answers: Result) -> Iterator[str]:
    pooled, came = answers["pooled"], [each for each in answers["participants"] if each["labels"]]
    yield paragraph(
        f"{count(len(came), 'participant')} gave {count(pooled['labels'], 'answer')} that models learned from"
        + (f" ({_range([each['labels'] for each in came])} each)." if came else "."),
        _accuracy(pooled),
        f"Pairs asked twice got the same answer in {pooled['same']:g} of {pooled['asked']} cases "
        f"({percent(pooled['same'] / pooled['asked'])})."
        if pooled["asked"]
        else "No pair that was asked twice had been answered both times.",
        _times(came),
    )
    if came:
        yield table(
            ("participant", "answers", "left / right / equal / can't tell", "predicted correctly", "same answer again"),
            [_answers_of(each) for each in came],
        )


def _accuracy(pooled: Result) -> str:
    if pooled["mean_accuracy"] is None:
        return "No answer could be compared with a prediction, so the reward models' accuracy is not known."
    return (
        f"On pairs drawn at random, predicted before they were answered, the reward models were right in "
        f"{percent(pooled['mean_accuracy'])}{share_interval(pooled['mean_low'], pooled['mean_high'])} of cases (mean "
        f"over {count(pooled['people'], 'person', 'people')})."
    )


def _times(came: Sequence[Result]) -> str:
    minutes = [each["working_minutes"] for each in came if each["working_minutes"] is not None]
    return f"Answering took {_range([round(each, 1) for each in minutes])} minutes, breaks left out." if minutes else ""


def _range(values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _answers_of(each: Result) -> Sequence[str]:
    share, again = each["accuracy"], each["test_retest"]
    accuracy = (
        f"{percent(share['accuracy'])}{share_interval(share['low'], share['high'])} of {share['scored']}"
        if share["scored"]
        else number(None)
    )
    kappa = f", κ = {number(again['kappa'])}{interval(again['kappa_low'], again['kappa_high'])}"
    same = f"{again['same']:g} of {again['asked']}{kappa if again['kappa'] is not None else ''}"
    said = " / ".join(str(each[name]) for name in ("left", "right", "equal", "skip"))
    return (each["participant"], str(each["labels"]), said, accuracy, same if again["asked"] else number(None))


def _change(change: Result) -> Iterator[str]:
    if not change["participants"]:
        yield "No filter had been evaluated."
        return
    yield (
        "In simulation, on unseen scenarios, the newest filters of "
        f"{count(len(change['participants']), 'participant')} changed the following against the pre-trained policy "
        "(means over people). Preference is in standard deviations of the pre-trained policy's return as each person's "
        "own model sees it, so it says that a filter follows its model, not that the person agrees."
    )
    rows = [
        (
            name,
            number(each["reference"], 3),
            f"{number(each['mean'], 3)}{interval(each['low'], each['high'], 3)}",
            str(each["people"]),
        )
        for name, each in change["pooled"].items()
    ]
    yield table(("measure", "pre-trained policy", "change, 95 % interval", "people"), rows)


def _ratings(ratings: Result, plan: Plan) -> Iterator[str]:
    if not ratings["ratings"]:
        yield "Nobody had rated a robot."
        return
    yield f"{count(ratings['participants'], 'person', 'people')} gave {count(ratings['ratings'], 'rating')}."
    for scale, found in ratings["scales"].items():
        yield f"### {scale.capitalize()}"
        yield _means(found["means"])
        sentences = [each for comparison in found["comparisons"] for each in _sentences(comparison, plan)]
        yield "\n".join(f"* {each}" for each in sentences)
        yield _all_tests(found["comparisons"], plan)
        yield _order(found["order"])


def _means(means: Sequence[Result]) -> str:
    rows = [
        (
            name_of(each["group"]),
            f"{number(each['mean'])} ({number(each['sd'])})",
            str(each["ratings"]),
            f"{number(each['participant_mean'])}{interval(each['low'], each['high'])}",
            str(each["participants"]),
        )
        for each in means
    ]
    return table(("robot", "mean of ratings (SD)", "ratings", "mean over people, 95 % interval", "people"), rows)


def _sentences(comparison: Result, plan: Plan) -> Iterator[str]:
    """The planned tests; where nothing was planned the one to rely on."""
    usual = RECOMMENDED
    if "welch_t" in comparison and has_number(comparison["welch_t"]) and not has_number(comparison[usual]):
        usual = "welch_t"
    named = [test for test in plan.planned if test in comparison] or [usual]
    for test in named:
        result = comparison[test]
        whole = f"{name_of(comparison['second'])} minus {name_of(comparison['first'])}, {TEST_NAMES[test]}"
        if not has_number(result):
            yield f"{whole}: not computable, because {result['not_computable']}."
            continue
        parts = [_difference(test, result), _statistic(test, result), p_value(result["p"])]
        parts += [p_value(result["p_holm"], "p (Holm)")] if "p_holm" in result else []
        parts += [_effect(test, result)] if _effect(test, result) else []
        yield f"{whole}: {', '.join(parts)}, {_n(test, result)}{'' if test in plan.planned else ' (exploratory)'}."


def _difference(test: str, result: Result) -> str:
    if test == "wilcoxon":
        return f"median difference {number(result['median'])}"
    if test in ("cumulative_link", "cumulative_link_between"):
        ends = interval(result["odds_ratio_low"], result["odds_ratio_high"])
        return f"odds ratio of a higher rating {number(result['odds_ratio'])}{ends}"
    if test in ("equivalence", "equivalence_between"):
        ends = interval(result["low_90"], result["high_90"])
        return f"difference {number(result['difference'])}, 90 % interval{ends}, bounds ±{result['bound']:g}"
    return f"difference {number(result['difference'])}{interval(result.get('low'), result.get('high'))}"


def _statistic(test: str, result: Result) -> str:
    if test == "wilcoxon":
        return f"W = {result['statistic']:g}"
    if test == "permutation":
        return f"{'all' if result['exact'] else 'drawn'} {result['ways']} ways to divide people"
    return f"t({number(result['degrees_of_freedom'], 1).removesuffix('.0')}) = {number(result['statistic'])}"


def _effect(test: str, result: Result) -> str:
    if test in ("equivalence", "equivalence_between"):
        return "equivalent within the bounds" if result["p_holm"] < 0.05 else "equivalence not shown"
    name, key = {
        "paired_t": ("d_z", "d_z"),
        "wilcoxon": ("rank-biserial r", "rank_biserial"),
        "welch_t": ("Hedges' g", "g"),
    }.get(test, ("", ""))
    if not key:
        return ""
    return f"{name} = {number(result[key])}{interval(result[f'{key}_low'], result[f'{key}_high'])}"


def _n(test: str, result: Result) -> str:
    more = f", {result['n_ratings']} ratings" if "n_ratings" in result else ""
    if "n_first" in result:
        of_each = f"n = {result['n_first']} and {result['n_second']}"
        return f"{of_each} {'ratings' if test == 'two_sample_t' else 'people'}{more}"
    moved = result.get("n_without_ties", result["n"])
    more += f", {moved} of them not equal" if moved != result["n"] else ""
    return f"n = {result['n']} people{more}"


def _all_tests(comparisons: Sequence[Result], plan: Plan) -> str:
    rows: list[Sequence[str]] = []
    for comparison in comparisons:
        for test in (each for each in TEST_NAMES if each in comparison):
            result = comparison[test]
            between = f"{name_of(comparison['second'])} \N{MINUS SIGN} {name_of(comparison['first'])}"
            start = (between, TEST_NAMES[test], "planned" if test in plan.planned else "exploratory")
            if has_number(result):
                holm = number(None) if "p_holm" not in result else p_value(result["p_holm"], "")
                numbers = (_difference(test, result), _statistic(test, result), p_value(result["p"], ""), holm)
                rows.append((*start, *numbers, _effect(test, result) or number(None), _n(test, result)))
            else:
                rows.append((*start, f"not computable: {result['not_computable']}", *[number(None)] * 5))
    return table(("comparison", "test", "", "difference", "statistic", "p", "p (Holm)", "effect", "n"), rows)


def _order(order: Result | None) -> str:
    if order is None:
        return ""
    found = []
    for name in ("period", "carryover"):
        effect = order[name]
        if has_number(effect):
            first, second = effect["degrees_of_freedom"]
            found.append(f"{name}: F({first}, {second}) = {number(effect['F'])}, {p_value(effect['p'])}")
        else:
            found.append(f"{name}: not computable, because {effect['not_computable']}")
    later = [
        f"block {each['period']} minus the first {number(each['difference'])}{interval(each['low'], each['high'])}"
        for each in order["by_period"]
    ]
    return f"Order effects ({count(order['people'], 'person', 'people')}): {'; '.join([*found, *later])}."


def _head_to_heads(found: Result) -> Iterator[str]:
    yield (
        f"{count(found['people'], 'person', 'people')} answered {count(found['answers'], 'head-to-head')}: left "
        f"{found['left']}, right {found['right']}, equal {found['equal']}."
    )
    if has_number(found):
        yield (
            "Bradley-Terry strengths (log odds, their sum is zero; an equal answer is half a win for each), with "
            "intervals that count people:"
        )
        rows = [
            (name_of(each["group"]), f"{number(each['strength'])}{interval(each['low'], each['high'])}")
            for each in found["strengths"]
        ]
        yield table(("robot", "strength, 95 % interval"), rows)
    else:
        yield f"Strengths are not computable, because {found['not_computable']}."
    if "comparisons" in found:
        head = "comparison", "difference of strengths", "first named preferred in", "test", "p", "p (Holm)"
        yield table(head, [_side_by_side(each) for each in found["comparisons"]])


def _side_by_side(compared: Result) -> tuple[str, ...]:
    tests = {"bradley_terry": "strengths", "wilcoxon": "Wilcoxon signed-rank", None: "\N{EN DASH}"}
    return (
        f"{name_of(compared['second'])} \N{MINUS SIGN} {name_of(compared['first'])}",
        f"{number(compared['difference'])}{interval(compared['low'], compared['high'])}",
        f"{percent(compared['chance'])}{share_interval(compared['chance_low'], compared['chance_high'])}",
        tests[compared["test"]],
        p_value(compared["p"], ""),
        p_value(compared["p_holm"], ""),
    )


def _guesses(found: Result) -> str:
    if not found["people"]:
        return "Nobody had named a robot."
    if found["right"] is None:
        return "Whether people named their own robot is not known."
    return (
        f"{found['right']} of {count(found['people'], 'person', 'people')} named their own robot "
        f"({percent(found['share'])}{share_interval(found['low'], found['high'])}; by chance "
        f"{percent(found['chance'])}; exact binomial test, two-sided, {p_value(found['p'])})."
    )


def _instruments(instruments: Sequence[Result]) -> Iterator[str]:
    for each in instruments:
        yield f"### {each['title']}"
        if not each["parts"]:
            yield "Nobody had filled it in."
        for part in each["parts"]:
            about_robots = bool(part["groups"][0])
            yield (
                f"{'About each robot' if about_robots else 'At the end'}: {count(part['people'], 'person', 'people')}."
            )
            yield table(
                ("score", "robot", "mean, 95 % interval", "SD", "people", f"{ALPHA}, 95 % interval", "ω"),
                [row for score in part["scores"] for row in _score_rows(score)],
            )
            left_out = [f"{score['title']} {score['left_out']}" for score in part["scores"] if score["left_out"]]
            yield f"Without a score, because an item was left out: {', '.join(left_out)}." if left_out else ""
            if about_robots and part["scores"][0]["comparisons"]:
                yield table(
                    ("score", "comparison", "test", "difference", "statistic", "p", "p (Holm)", "effect", "n"),
                    [row for score in part["scores"] for row in _score_tests(score)],
                )
    yield (
        f"{ALPHA}: Cronbach's, with the interval of Feldt and colleagues; ω: McDonald's, of one factor, or of two "
        "items the Spearman-Brown coefficient (marked SB). A dash: one item, fewer than three people, answers that did "
        "not vary, or a model that could not be fitted. All tests of questionnaires are exploratory; Holm's correction "
        "is over the comparisons of one score."
    )


def _score_rows(score: Result) -> Iterator[Sequence[str]]:
    for mean, agreement in zip(score["means"], score["reliability"], strict=True):
        found = has_number(agreement)
        alpha = (
            f"{number(agreement['alpha'])}{interval(agreement['low'], agreement['high'])}" if found else number(None)
        )
        omega = number(agreement["omega"]) if found else number(None)
        if found and agreement["spearman_brown"] is not None:
            omega = f"{number(agreement['spearman_brown'])} (SB)"
        value = f"{number(mean['participant_mean'])}{interval(mean['low'], mean['high'])}"
        people = str(mean["participants"])
        ends = f"{score['title']} ({score['lowest']:g} to {score['highest']:g})"
        yield (ends, name_of(mean["group"]) or number(None), value, number(mean["sd"]), people, alpha, omega)


def _score_tests(score: Result) -> Iterator[Sequence[str]]:
    for comparison in score["comparisons"]:
        between = f"{name_of(comparison['second'])} \N{MINUS SIGN} {name_of(comparison['first'])}"
        for test in (each for each in TEST_NAMES if each in comparison):
            result = comparison[test]
            start = (score["title"], between, TEST_NAMES[test])
            if not has_number(result):
                yield (*start, f"not computable: {result['not_computable']}", *[number(None)] * 5)
                continue
            numbers = (_difference(test, result), _statistic(test, result), p_value(result["p"], ""))
            yield (*start, *numbers, p_value(result["p_holm"], ""), _effect(test, result), _n(test, result))
