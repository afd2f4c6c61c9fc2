"""The figures of a report: from its contents to SVG (text as text) and PNG (300 dpi), the same bytes every time.

Colours are told apart by people with any colour vision, and in grey: they are Okabe and Ito's, chosen to differ in
lightness too; groups also differ in hatch or marker.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from worker.analysis.study.statistics import POINTS, SCALES

DPI = 300
INK, GREY, PALE = "#262626", "#8a8a8a", "#dddddd"
COLOURS = ("#d9d9d9", "#e69f00", "#0072b2", "#56b4e9", "#762a83")
"""Of bars; neighbours differ in lightness, and hatches tell them apart in grey."""
HATCHES = ("", "///", "", "...", "xx")
MARKERS = ("o", "s", "^", "D", "v")
LINE_COLOURS = ("#7a7a7a", "#b87700", "#0072b2", "#009e73", "#762a83")
"""Of lines and points, which need more contrast than areas."""
NAMES = {
    "reference": "Pre-trained policy",
    "prefft": "PrefFT",
    "prefft_anchored": "PrefFT, anchored",
    "pbarl": "PbARL",
    "pbarl_printed": "PbARL as printed",
    "somebody_else": "Somebody else's filter",
    "average": "Average filter",
    "self_set": "Set by the person",
}
COST_NAMES = {
    "C_d": "Distance (C_d)",
    "C_v": "Speed (C_v)",
    "C_f": "Force away (C_f)",
    "C_hf": "High force (C_hf)",
    "C_fd": "Spilling (C_fd)",
    "C_fdv": "Intake speed (C_fdv)",
}
STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "pbarl-studio",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "hatch.linewidth": 0.7,
    "legend.frameon": False,
    "mathtext.fontset": "dejavusans",
}


def name_of(group: str) -> str:
    """What a method, or a letter, is called in a figure."""
    return NAMES.get(group, f"Robot {group}")


def all_figures(contents: Mapping[str, Any]) -> dict[str, dict[str, bytes]]:
    """Every figure that the contents have something for: {name: {"svg": ..., "png": ...}}."""
    drawn = {name: draw(contents) for name, draw in _FIGURES.items()}
    return {name: rendered(figure) for name, figure in drawn.items() if figure is not None}


def rendered(figure: Figure) -> dict[str, bytes]:
    """The figure in both formats, without dates or versions inside."""
    files = {}
    with mpl.rc_context(STYLE):
        figure.draw_without_rendering()
        cut = figure.get_tightbbox().padded(0.08)
        figure.set_layout_engine(None)  # it is laid out: savefig would do so twice for each format
        for kind, metadata in (("svg", {"Date": None, "Creator": None}), ("png", {"Software": None})):
            target = io.BytesIO()
            figure.savefig(target, format=kind, dpi=DPI, metadata=metadata, bbox_inches=cut)
            files[kind] = target.getvalue()
    return files


def ratings_as_in_the_paper(contents: Mapping[str, Any]) -> Figure | None:
    """Mean ratings of both scales with standard deviations, brackets and stars: the paper's figure."""
    ratings = contents["ratings"]
    if not ratings["ratings"]:
        return None
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.3), layout="constrained")
        for axes, scale in zip(figure.subplots(1, len(SCALES), sharey=True), SCALES, strict=True):
            _bars(axes, ratings["groups"], ratings["scales"][scale])
            axes.set_title(scale.capitalize())
        figure.axes[0].set_ylabel("Mean rating (1 to 5)")
    return figure


def _bars(axes: Axes, groups: Sequence[str], scale: Mapping[str, Any]) -> None:
    places = dict(zip(groups, range(len(groups)), strict=True))
    for place, each in enumerate(scale["means"]):
        if each["mean"] is None:
            continue
        axes.bar(
            place,
            each["mean"] - 1,
            0.66,
            bottom=1,
            color=COLOURS[place],
            hatch=HATCHES[place],
            edgecolor=INK,
            linewidth=0.8,
        )
        if each["sd"] is not None:
            axes.errorbar(place, each["mean"], each["sd"], color=INK, capsize=3, linewidth=1, capthick=1)
    tops = [(each["mean"] or 0) + (each["sd"] or 0) for each in scale["means"]]
    tested = [each for each in scale["comparisons"] if "not_computable" not in each["two_sample_t"]]
    top = _brackets(axes, tested, places, tops)
    axes.set_xticks(range(len(groups)), [_in_two_lines(group) for group in groups])
    axes.tick_params(axis="x", length=0)
    axes.set_yticks(range(1, 6))
    axes.set_ylim(1, max(5.35, top))
    axes.spines["left"].set_bounds(*POINTS)
    axes.set_xlim(-0.6, len(groups) - 0.4)


def _brackets(
    axes: Axes, comparisons: Sequence[Mapping[str, Any]], places: Mapping[str, int], tops: Sequence[float]
) -> float:
    """Brackets between compared bars, the narrow ones below; a star or "n.s." on each. Returns how high they reach."""
    level, step = max([5.0, *tops]) + 0.25, 0.5
    ordered = sorted(
        comparisons, key=lambda each: (places[each["second"]] - places[each["first"]], places[each["first"]])
    )
    for each in ordered:
        left, right = places[each["first"]] + 0.04, places[each["second"]] - 0.04
        axes.plot([left, left, right, right], [level - 0.1, level, level, level - 0.1], color=INK, linewidth=0.9)
        star = each["two_sample_t"]["star"]
        text, size = ("*", 13) if star else ("n.s.", 8)
        axes.text((left + right) / 2, level + (-0.04 if star else 0.04), text, ha="center", va="bottom", fontsize=size)
        level += step
    return level


def ratings_of_each_person(contents: Mapping[str, Any]) -> Figure | None:
    """Every person's mean rating of each method as a line: who rates all high, and who changed."""
    ratings = contents["ratings"]
    if not ratings["ratings"]:
        return None
    groups = ratings["groups"]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.3), layout="constrained")
        for axes, scale in zip(figure.subplots(1, len(SCALES), sharey=True), SCALES, strict=True):
            people = ratings["scales"][scale]["people"]
            for index, person in enumerate(people):
                _line_of(axes, groups, person["means"], (index - (len(people) - 1) / 2) * 0.16 / max(1, len(people)))
            for place, each in enumerate(ratings["scales"][scale]["means"]):
                _mean_mark(axes, place, each)
            axes.set_xticks(range(len(groups)), [_in_two_lines(group) for group in groups])
            axes.set_xlim(-0.4, len(groups) - 0.6)
            axes.set_yticks(range(1, 6))
            axes.set_ylim(0.8, 5.2)
            axes.spines["left"].set_bounds(*POINTS)
            axes.set_title(scale.capitalize())
        figure.axes[0].set_ylabel("Mean rating of each person")
        _legend_of_means(figure.axes[1])
    return figure


def _line_of(axes: Axes, groups: Sequence[str], means: Mapping[str, float], shift: float) -> None:
    places = [place for place, group in enumerate(groups) if group in means]
    values = [means[groups[place]] for place in places]
    axes.plot([place + shift for place in places], values, color=GREY, linewidth=0.9, alpha=0.8, zorder=2)
    axes.plot(
        [place + shift for place in places], values, "o", color="white", markeredgecolor=GREY, markersize=4, zorder=3
    )


def _legend_of_means(axes: Axes) -> None:
    axes.plot([], [], "o-", color=GREY, markerfacecolor="white", markersize=4, linewidth=0.9, label="each person")
    axes.plot([], [], "D-", color=LINE_COLOURS[2], markersize=5, linewidth=2, label="mean, 95 % interval")
    figure = axes.get_figure(root=True)
    if figure is not None:
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)


def _mean_mark(axes: Axes, place: int, each: Mapping[str, Any]) -> None:
    """The mean over people with its 95 % interval, beside the lines."""
    if each["participant_mean"] is None:
        return
    at, colour = place + 0.22, LINE_COLOURS[2]
    if each["low"] is not None:
        axes.plot([at, at], [max(0.8, each["low"]), min(5.2, each["high"])], color=colour, linewidth=2, zorder=4)
    axes.plot(at, each["participant_mean"], "D", color=colour, markersize=6, zorder=5)


def head_to_head_strengths(contents: Mapping[str, Any]) -> Figure | None:
    """Bradley-Terry strengths (log odds, sum zero) with 95 % intervals, the strongest on top."""
    found = (contents.get("head_to_heads") or {}).get("strengths")
    if not found:
        return None
    ordered = sorted(found, key=lambda each: float(each["strength"]), reverse=True)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.6, 0.45 * len(ordered) + 0.9), layout="constrained")
        axes = figure.subplots()
        axes.axvline(0, color=INK, linewidth=0.8)
        for row, each in enumerate(ordered):
            if each["low"] is not None:
                axes.plot([each["low"], each["high"]], [row, row], color=GREY, linewidth=1.2, zorder=2)
            axes.plot(each["strength"], row, "D", color=LINE_COLOURS[2], markersize=6.5, zorder=3)
        axes.set_yticks(range(len(ordered)), [name_of(each["group"]) for each in ordered])
        axes.set_ylim(len(ordered) - 0.4, -0.6)
        axes.set_xlabel("Strength (log odds against the average robot; right: preferred)")
        axes.xaxis.grid(True, color=PALE, linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
    return figure


def learning_curves(contents: Mapping[str, Any]) -> Figure | None:
    """Running share of answers that the model had foreseen: each person thin, the mean over people thick."""
    curves = [np.array(each["curve"]) for each in contents["answers"]["participants"] if len(each["curve"]) > 1]
    if not curves:
        return None
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.2, 3.2), layout="constrained")
        axes = figure.subplots()
        for each in curves:
            axes.plot(each[:, 0], each[:, 1] * 100, color=GREY, linewidth=0.8, alpha=0.6)
        longest = max(curves, key=len)[:, 0]
        together = [[each[row, 1] for each in curves if row < len(each)] for row in range(len(longest))]
        whole = [row for row, values in enumerate(together) if len(values) == len(curves)]
        axes.plot([], [], color=GREY, linewidth=0.8, label="each person")
        if len(curves) > 1:
            mean = [float(np.mean(together[row])) * 100 for row in whole]
            axes.plot(longest[whole], mean, color=LINE_COLOURS[2], linewidth=2.2, label=f"mean of {len(curves)} people")
        axes.legend(loc="lower right")
        axes.axhline(50, color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
        axes.annotate(
            "chance", (1, 50), (-2, 3), xycoords=("axes fraction", "data"), textcoords="offset points", ha="right"
        )
        axes.set_ylim(0, 101)
        axes.set_xlim(0, float(longest[-1]) * 1.02)
        axes.set_xlabel("Answers that preferred a side, on pairs drawn at random")
        axes.set_ylabel(f"Predicted correctly of the last {contents['answers']['window']} (%)")
        axes.yaxis.grid(True, color=PALE, linewidth=0.6)
        axes.set_axisbelow(True)
    return figure


def success_against_preference(contents: Mapping[str, Any]) -> Figure | None:
    """What each person's filter gains in learned preference and costs in success, with 95 % intervals."""
    people = [
        (each["participant"], each["measures"]["preference"], each["measures"]["success"])
        for each in contents["change"]["participants"]
        if {"success", "preference"} <= each["measures"].keys()
    ]
    if not people:
        return None
    proven = {each["participant"] for each in contents["answers"]["participants"] if each["foresight"] == "better"}
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.2, 3.6), layout="constrained")
        axes = figure.subplots()
        axes.axhline(0, color=INK, linewidth=0.8)
        axes.axvline(0, color=INK, linewidth=0.8)
        for code, preference, success in people:
            x, y = preference["delta"], success["delta"] * 100
            axes.plot([preference["low"], preference["high"]], [y, y], color=GREY, linewidth=0.9, zorder=2)
            axes.plot([x, x], [success["low"] * 100, success["high"] * 100], color=GREY, linewidth=0.9, zorder=2)
            inside, edge = (LINE_COLOURS[2], LINE_COLOURS[2]) if code in proven else ("white", GREY)
            axes.plot(x, y, "o", color=inside, markeredgecolor=edge, markersize=6, zorder=3)
        axes.set_xlabel("Change of preference (SD of the reference's return,\nas the person's own model sees it)")
        axes.set_ylabel("Change of success (percentage points)")
        axes.margins(0.12)
        figure.draw_without_rendering()  # settles the layout, and with it what is where
        _label(axes, [(code, x["delta"], y["delta"] * 100) for code, x, y in people])
    return figure


def _label(axes: Axes, points: Sequence[tuple[str, float, float]]) -> None:
    """Name the points, each at the first place beside it that no other name has taken. Sizes in typographic points."""
    taken: list[tuple[float, float]] = []
    scale = 72 / float(mpl.rcParams["figure.dpi"])
    for code, x, y in sorted(points, key=lambda each: (each[1], each[2])):
        at = np.array(axes.transData.transform((x, y))) * scale
        width = 5.5 * len(code)
        places = ((6, 5), (6, -12), (-6 - width, 5), (-6 - width, -12), (6, 16), (6, -23), (-6 - width, 16))
        free = [
            place
            for place in places
            if all(abs(at[0] + place[0] - a) > width or abs(at[1] + place[1] - b) > 10 for a, b in taken)
        ]
        offset = (free or places)[0]
        taken.append((float(at[0]) + offset[0], float(at[1]) + offset[1]))
        axes.annotate(code, (x, y), offset, textcoords="offset points", fontsize=8, zorder=4)


def cost_changes(contents: Mapping[str, Any]) -> Figure | None:
    """The paper's six costs: change of each person in percent of the reference, and the mean over people."""
    pooled, people = contents["change"]["pooled"], contents["change"]["participants"]
    names = [name for name in COST_NAMES if name in pooled]
    if not names:
        return None
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.6, 0.5 * len(names) + 1.2), layout="constrained")
        axes = figure.subplots()
        axes.axvline(0, color=INK, linewidth=0.8)
        for row, name in enumerate(names):
            relative = [
                each for each in (_relative(person["measures"].get(name)) for person in people) if each is not None
            ]
            spread = np.linspace(-0.18, 0.18, len(relative)) if len(relative) > 1 else np.zeros(len(relative))
            axes.plot(relative, row + spread, "o", color="white", markeredgecolor=GREY, markersize=4.5, zorder=2)
            if relative:
                axes.plot(np.mean(relative), row, "D", color=LINE_COLOURS[2], markersize=6.5, zorder=3)
        axes.set_yticks(range(len(names)), [COST_NAMES[name] for name in names])
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.set_xlabel("Change in % of the reference (left: less of the cost)")
        axes.xaxis.grid(True, color=PALE, linewidth=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
        axes.plot([], [], "o", color="white", markeredgecolor=GREY, markersize=4.5, label="each person")
        axes.plot([], [], "D", color=LINE_COLOURS[2], markersize=6.5, label="mean")
        axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0.2)
    return figure


def _relative(measured: Mapping[str, Any] | None) -> float | None:
    """Change in percent; None where the reference has none of this cost."""
    if not measured or not measured["reference"] or measured["delta"] is None:
        return None
    return 100 * float(measured["delta"]) / float(measured["reference"])


def _in_two_lines(group: str) -> str:
    return name_of(group).replace(" ", "\n", 1)


_FIGURES: dict[str, Callable[[Mapping[str, Any]], Figure | None]] = {
    "ratings": ratings_as_in_the_paper,
    "ratings_of_each_person": ratings_of_each_person,
    "head_to_heads": head_to_head_strengths,
    "learning_curves": learning_curves,
    "success_against_preference": success_against_preference,
    "cost_changes": cost_changes,
}
