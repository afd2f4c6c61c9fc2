"""What people gain from modes who are not what the reward model takes them for, and whether their own serves them best.

    python -m tests.benchmarks.other_users

Per task and person: 200 answers to pairs of a pool as large as a study's, a reward model, the mode that the search
finds for it (no trials, no residual), driven through unseen scenarios. Every episode is judged by the true wishes of
everybody, tests/benchmarks/nonlinear_people.py and the paper's three types, so each mode also shows what it would be to
the others. Where the model does not fit (worker.ml.rewards.beyond_sums.misfit), the mode for the richer model that
explains most is driven, too. On one core; finished modes are kept under --work-directory, so that it can be repeated to
go on.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tqdm import tqdm

from app.services.answers.accuracy import ENOUGH_EVIDENCE
from tests.benchmarks import result_tables
from tests.benchmarks.answered_pool import Answered, AnsweredPool
from tests.benchmarks.nonlinear_people import ON_TIME_S, PEOPLE, Person, as_type
from worker.analysis.comparison import result_pages
from worker.compute import learning, simulation
from worker.domain.modes import ModeFamily
from worker.domain.scenarios import EVALUATION, first_of
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import FloatArray
from worker.experiments.rollout_cache import BEHAVIOURS_PER_SCENARIO, RolloutCache
from worker.ml.filters.fitting.response_surface import RIDGE, ResponseSurface, best_mode, monomials
from worker.ml.rewards.beyond_sums import misfit
from worker.ml.rewards.prior import DEVIATION, Population, Prior
from worker.ml.rewards.reward_training import fit, posterior
from worker.ml.rewards.segments import SegmentPairs
from worker.ml.teachers import User
from worker.whole_files import written_whole

TITLE = "# What people gain who are not linear"
TYPES: Mapping[str, Person] = {user.value: Person(user.value, as_type(user)) for user in User}
EVERYBODY = {**PEOPLE, **TYPES}
LINEAR, RICHER = "linear", "richer"
ANSWERS = 200
MEMBERS = 8
SMALLEST = 1e-6


def main() -> None:
    """Drive what is missing, then write table and page."""
    options = _options()
    torch.set_num_threads(1)
    benches: dict[str, Bench] = {}
    planned = list(product(range(options.seeds), options.tasks, options.people, (LINEAR, RICHER)))
    for seed, task, name, model in tqdm(planned, unit="mode", mininterval=10):
        kept = _file(options, seed, task, name, model)
        if not kept.exists() and (model == LINEAR or _is_flagged(_file(options, seed, task, name, LINEAR))):
            if task not in benches:
                benches[task] = Bench(task, options.work_directory / "rollouts")
            benches[task].measure(EVERYBODY[name], seed, model, options.scenarios, kept)
        _write(planned, options)


class Bench:
    """One task: its pool, its response surface, and what unseen scenarios are worth to everybody."""

    def __init__(self, task: str, rollouts: Path) -> None:
        self.pool = AnsweredPool(task, rollouts)
        self.cache = RolloutCache(task, rollouts)
        self.surface = ResponseSurface.load(simulation.surface_file(task), self.pool.task.modes)

    def measure(self, person: Person, seed: int, model: str, scenarios: int, kept: Path) -> None:
        """Answer, learn, search a mode, drive it."""
        answered = self.pool.answered(person, ANSWERS, seed)
        ratios = self.pool.ratios(answered, ANSWERS)
        explained_by = max(ratios, key=lambda each: ratios[each])
        if model == LINEAR:
            mode = best_mode(self.surface, self._linear(answered, seed), seed)
        else:
            mode = self._richer(answered, seed, explained_by)
        unseen = first_of(EVALUATION, scenarios, skip=seed * scenarios)
        name = self.pool.task.name
        driven = learning.run_scenarios(name, simulation.act_in_mode(name, mode), unseen, 0.0, 0)
        found = {
            "evidence": misfit.evidence(ratios),
            "explained_by": explained_by,
            "mode": mode,
            **self._judged("driven", driven),
            **self._judged("reference", self.cache.reference(unseen)),
        }
        kept.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(kept) as path:
            np.savez_compressed(path, allow_pickle=False, **found)

    def _judged(self, which: str, episodes: Sequence[Trajectory]) -> dict[str, Any]:
        return {
            f"{which}_success": [each.success for each in episodes],
            f"{which}_force": [each.contact_force_n.max() for each in episodes],
            **{
                f"{which}_{name}": [person.wishes(self.pool.task, each).sum() for each in episodes]
                for name, person in EVERYBODY.items()
            },
        }

    def _linear(self, answered: Answered, seed: int) -> FloatArray:
        pairs = self.pool.segments.take(answered.rows)
        return fit(pairs, answered.answers, "structured", seed, scale=self.pool.scale).model.signal_weights(())

    def _richer(self, answered: Answered, seed: int, explained_by: str) -> FloatArray:
        """(A,) the mode for the richer model that explains most."""
        sums, spread = self.pool.sums[answered.rows], self.pool.scale.spread
        if explained_by == misfit.CHANGING:
            more, used = misfit.changing(sums), spread
        else:
            raw = self.pool.further[explained_by][answered.rows]
            more, used = misfit.by_spread(raw), np.sqrt((raw**2).mean(axis=0))
        deviations = np.append(np.full(sums.shape[1], DEVIATION), np.full(more.shape[1], misfit.RICHER_DEVIATION))
        prior = Prior((Population("anybody", np.zeros(len(deviations)), np.diag(deviations**2)),))
        known = posterior(np.concatenate([sums, more], axis=1), answered.answers, prior)
        half = np.random.default_rng(seed).multivariate_normal(known.mean, known.covariance, MEMBERS // 2)
        members = np.concatenate([half, 2 * known.mean - half])
        of_sums, further = members[:, : len(spread)] / spread, members[:, len(spread) :]
        if explained_by == misfit.CHANGING:
            last = np.sqrt(3.0)  # the last answer's number in deviations from the middle one
            return best_mode(self.surface, of_sums + last * further / used, seed)
        wishes = np.concatenate([of_sums, further / np.where(used > SMALLEST, used, np.inf)], axis=1)
        coefficients = np.concatenate([self.surface.coefficients, self._of_modes[explained_by]], axis=1)
        return best_mode(replace(self.surface, coefficients=coefficients), wishes, seed)

    @cached_property
    def _of_modes(self) -> dict[str, FloatArray]:
        """(M, F) of each group: what modes do to its features, from the pool's behaviours that are a mode and nothing
        else, each compared with the others of its scenario."""
        task, scenarios = self.pool.task, np.array([each.scenario for each in self.pool.clips])
        shown = [
            each
            for scenario in dict.fromkeys(scenarios.tolist())
            for each in simulation.behaviours(task.name, scenario, BEHAVIOURS_PER_SCENARIO)
        ]
        modes = np.array([_mode_of(task.modes, each.described()) for each in shown])
        plain = ~np.isnan(modes).any(axis=1)
        whole = SegmentPairs.cut([(each, each) for each in self.pool.clips])
        found = misfit.further_sums(whole, SIGNALS, misfit.scene_of(task.observation))
        within = _centred(scenarios[plain], monomials(modes[plain]))
        gram = within.T @ within + RIDGE * np.eye(within.shape[1])
        return {
            name: np.asarray(np.linalg.solve(gram, within.T @ _centred(scenarios[plain], each[plain, 0])), np.float64)
            for name, each in found.items()
        }


def _mode_of(family: ModeFamily, described: Mapping[str, Any]) -> FloatArray:
    """(A,) of a behaviour as it is stored with a rollout; nan where something else than the mode was different, too."""
    if described.keys() - {"mode"}:
        return np.full(len(family.axes), np.nan)
    return np.array(family.vector(described.get("mode", {})))


def _centred(groups: npt.NDArray[np.int64], values: FloatArray) -> FloatArray:
    """(N, F) less the mean of its group."""
    centred = values.copy()
    for group in np.unique(groups):
        centred[groups == group] -= values[groups == group].mean(axis=0)
    return centred


def _is_flagged(kept: Path) -> bool:
    return float(np.load(kept)["evidence"]) >= ENOUGH_EVIDENCE


def _file(options: argparse.Namespace, seed: int, task: str, name: str, model: str) -> Path:
    folder: Path = options.work_directory / "other_users"
    return folder / f"{task}-{name}-{seed}-{model}.npz"


def _write(planned: Sequence[tuple[int, str, str, str]], options: argparse.Namespace) -> None:
    """The table and the page of everything that is finished."""
    files = {each: _file(options, *each) for each in planned}
    kept = {each: dict(np.load(file)) for each, file in files.items() if file.exists()}
    rows = [_row(each, kept) for each in kept if each[3] == LINEAR]
    result_tables.write(options.output.with_suffix(".csv"), rows)
    page = options.output.with_suffix(".md")
    page.write_text(result_pages.page(page, TITLE, _table(rows)))


def _row(
    which: tuple[int, str, str, str], kept: Mapping[tuple[int, str, str, str], Mapping[str, Any]]
) -> dict[str, Any]:
    """One person's own mode beside the best of the others', and beside that of the richer model."""
    seed, task, name, _ = which
    own = kept[which]
    unit = np.abs(own[f"reference_{name}"].mean()) / 100
    others = {
        other: each[f"driven_{name}"]
        for (of_seed, of_task, other, model), each in kept.items()
        if (of_seed, of_task, model) == (seed, task, LINEAR) and other != name
    }
    best = max(others, key=lambda other: others[other].mean(), default="")
    gain = (own[f"driven_{name}"] - own[f"reference_{name}"]) / unit
    advantage = (own[f"driven_{name}"] - others[best]) / unit if best else np.full(2, np.nan)
    richer = kept.get((seed, task, name, RICHER))
    flagged = float(own["evidence"]) >= ENOUGH_EVIDENCE
    more = np.full(2, np.nan)
    if richer is not None:
        more = (richer[f"driven_{name}"] - own[f"driven_{name}"]) / unit
    success = 100 * (own["driven_success"].mean() - own["reference_success"].mean())
    return {
        "task": task,
        "person": name,
        "seed": seed,
        "scenarios": len(gain),
        **_measured("gain", gain),
        "best_other": best,
        **_measured("advantage", advantage),
        "success_points": round(float(success), 1),
        "evidence": float(f"{float(own['evidence']):.3g}"),
        "explained_by": str(own["explained_by"]) if flagged else "",
        **_measured("richer_more", more),
    }


def _measured(name: str, values: FloatArray) -> dict[str, float]:
    """Mean and 95 % interval over scenarios."""
    half = 1.96 * float(values.std(ddof=1)) / np.sqrt(len(values))
    mean = float(values.mean())
    return {name: round(mean, 2), f"{name}_low": round(mean - half, 2), f"{name}_high": round(mean + half, 2)}


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    lines = [
        "| task | person | seed | own gain, % | beyond the best other's, points | which is | success, points |"
        " model does not fit | a richer one gains more, points |",
        "|---" * 9 + "|",
    ]
    for row in rows:
        gain, advantage, more = (_with_interval(row, name) for name in ("gain", "advantage", "richer_more"))
        fits = row["explained_by"] or "-"
        lines.append(
            f"| {row['task']} | {row['person']} | {row['seed']} | {gain} | {advantage} | {row['best_other']}"
            f" | {row['success_points']:+.1f} | {fits} | {more} |"
        )
    return "\n".join(lines) + "\n"


def _with_interval(row: Mapping[str, Any], name: str) -> str:
    if np.isnan(row[name]):
        return "-"
    return f"{row[name]:+.1f} [{row[f'{name}_low']:+.1f}, {row[f'{name}_high']:+.1f}]"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=[*ON_TIME_S], default=["feeding"])
    parser.add_argument("--people", nargs="+", choices=[*EVERYBODY], default=[*EVERYBODY])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--scenarios", type=int, default=60)
    parser.add_argument("--work-directory", type=Path, default=Path("data/benchmark"), help="of rollouts and modes")
    parser.add_argument("--output", type=Path, default=Path("docs/results/other_users"), help="stem of both files")
    return parser.parse_args()


if __name__ == "__main__":
    main()
