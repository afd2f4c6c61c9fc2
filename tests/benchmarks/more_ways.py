"""Are noise, a gain of one action, or learned axes worth having beside the ways there are? docs/results/foreign.md.

    python -m tests.benchmarks.more_ways reach reacher

For each of the three opposed users of tests.benchmarks.foreign the best mode among the ways there are is searched by
what they truly want. Then every further way is tried on top of it, a few values each, and the best value that keeps
success is driven in unseen scenarios. No number of answers could make more of it. ``LAB_TASKS`` names the folders of
the two examples, and reacher's policy server has to be there.
"""

import argparse
import csv
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.benchmarks import foreign
from worker.compute import simulation
from worker.domain.scenarios import EVALUATION, POOL, first_of
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, Float32Array, FloatArray
from worker.tasks import registry

SEARCHED, CHOSEN, UNSEEN = (
    first_of(POOL, 8, skip=910_000),
    first_of(POOL, 20, skip=915_000),
    first_of(EVALUATION, 40, skip=700),
)
GENERATIONS, POPULATION, ELITE = 4, 12, 3
NOISE = 0.3
"""Standard deviation of an action in [-1, 1] at temperature 1: a trained policy's own is seldom larger."""
KNOTS, OFFSET, OFFSETS, LEARNED = 4, 0.3, 120, 3
"""Learned axes: a pool of random offsets of the actions over the way, each with so many places and at most so large."""
ONE_ACTION = {"reach": 2, "reacher": 1}
"""Whose gain is tried: upwards, and the elbow's."""
LOST_SUCCESS = 0.05
FILE = Path("docs/results/more_ways.csv")
COLUMNS = ("task", "user", "way", "more", "more_low", "more_high", "success", "value")
Changed = Callable[[Float32Array, FloatArray, Float32Array], Float32Array]
"""(D,), coordinates, (A,) -> (A,)"""


class Way(NamedTuple):
    """A further kind of way: the action becomes another, by some coordinates."""

    changed: Changed
    values: FloatArray
    """(N, C) to be tried"""

    def act(self, usual: Act, value: FloatArray) -> Act:
        """On top of what is done otherwise."""
        return lambda seen: self.changed(seen, value, usual(seen))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="+", help=" or ".join(foreign.USERS))
    parser.add_argument("--seeds", nargs="+", type=int, default=(0,), help="of the search")
    parser.add_argument("--file", type=Path, default=FILE)
    said = parser.parse_args()
    rows = [row for task in said.tasks for seed in said.seeds for row in table(task, seed)]
    with said.file.open("w", newline="") as target:
        csv.writer(target, lineterminator="\n").writerows([COLUMNS, *rows])


def table(name: str, seed: int) -> list[tuple[object, ...]]:
    """For every user what each further kind of way adds in unseen scenarios, in spreads of a pair."""
    scale, actions = foreign._scale(name, foreign._pool(name, 60)), registry.task(name).action.size
    ways = {
        "noise": Way(_noise, np.array([[0.25], [0.5], [1.0]])),
        "gain": Way(_gain_of(ONE_ACTION[name], actions), np.array([[-0.8], [-0.4], [0.3], [0.6]])),
        "learned": Way(
            _learned(name, actions, seed), np.kron(np.eye(LEARNED), np.array([[-1.0], [-0.5], [0.5], [1.0]]))
        ),
    }
    rows: list[tuple[object, ...]] = []
    for who, weights in foreign._wants(name).items():
        wanted = weights / scale.spread
        mode = _best_mode(name, wanted, np.random.default_rng([seed, 1]))
        best, usual = simulation.act_in_mode(name, mode), _driven(name, simulation.act_in_mode(name, mode), CHOSEN)
        before = _driven(name, best, UNSEEN)
        for way, each in ways.items():
            tried = {tuple(value): _driven(name, each.act(best, value), CHOSEN) for value in each.values}
            kept = {
                value: driven for value, driven in tried.items() if _success(driven) >= _success(usual) - LOST_SUCCESS
            }
            if not kept:
                rows.append((name, who, way, "", "", "", "", "none keeps success"))
                continue
            value = max(kept, key=lambda value: float(np.mean(_sums(kept[value]) @ wanted)))
            after = _driven(name, each.act(best, np.array(value)), UNSEEN)
            more = (_sums(after) - _sums(before)) @ wanted
            half = foreign.CRITICAL * float(more.std(ddof=1)) / len(more) ** 0.5
            numbers = (more.mean(), more.mean() - half, more.mean() + half, _success(after) - _success(before))
            rows.append((name, who, way, *(round(float(each), 3) for each in numbers), " ".join(map(str, value))))
            sys.stdout.write(f"{rows[-1]}\n")
            sys.stdout.flush()
    return rows


def _sums(driven: list[Trajectory]) -> FloatArray:
    return np.array([each.signals.sum(axis=0, dtype=np.float64) for each in driven])


def _success(driven: list[Trajectory]) -> float:
    return float(np.mean([each.success for each in driven]))


def _driven(name: str, act: Act, scenarios: tuple[int, ...] | range) -> list[Trajectory]:
    return [simulation.run_episode(name, act, scenario) for scenario in scenarios]


def _best_mode(name: str, wanted: FloatArray, rng: np.random.Generator) -> FloatArray:
    """By the cross-entropy method; what loses success is out."""
    axes = registry.task(name).modes.axes
    low, high = (np.array([getattr(axis, end) for axis in axes]) for end in ("low", "high"))
    mean, spread = np.zeros(len(axes)), (high - low) / 2.0
    usual = _success(_driven(name, simulation.act_in_mode(name, mean), SEARCHED))
    best, most = mean, -np.inf
    for _ in range(GENERATIONS):
        tried = np.clip(rng.normal(mean, spread, (POPULATION, len(axes))), low, high)
        tried[0] = mean
        returns = []
        for mode in tried:
            driven = _driven(name, simulation.act_in_mode(name, mode), SEARCHED)
            kept = _success(driven) >= usual - LOST_SUCCESS
            returns.append(float(np.mean(_sums(driven) @ wanted)) if kept else -np.inf)
        order = [place for place in np.argsort(returns)[::-1][:ELITE] if np.isfinite(returns[place])]
        if order and returns[order[0]] > most:
            best, most = tried[order[0]], returns[order[0]]
        mean, spread = tried[order or [0]].mean(axis=0), 0.5 * spread + 0.5 * tried[order or [0]].std(axis=0)
    return best


# Further kinds of ways: each a function of one observation and one action, as filters are


def _noise(seen: Float32Array, temperature: FloatArray, action: Float32Array) -> Float32Array:
    """Samples of a normal distribution that are the same for the same observation."""
    rng = np.random.default_rng(np.frombuffer(np.ascontiguousarray(seen, np.float32).tobytes(), np.uint32))
    drawn: Float32Array = action + np.float32(NOISE * temperature[0]) * rng.standard_normal(len(action), np.float32)
    return drawn


def _gain_of(index: int, actions: int) -> Changed:
    alone = np.eye(actions, dtype=np.float32)[index]
    return lambda seen, gain, action: action * np.exp(np.float32(gain[0]) * alone)


def _offset(places: Float32Array, left: float) -> Float32Array:
    """(KNOTS, A) at a share of the episode that is left -> (A,), in between by the nearest two."""
    at = np.clip(left, 0.0, 1.0) * (KNOTS - 1)
    below = min(int(at), KNOTS - 2)
    found: Float32Array = places[below] + np.float32(at - below) * (places[below + 1] - places[below])
    return found


def _learned(name: str, actions: int, seed: int) -> Changed:
    """The directions among offsets of the actions over the episode in which a pool of them differs most in what is
    measured: the first right singular vectors of the regression of signals on offsets."""
    rng, policy = np.random.default_rng([seed, 3]), simulation.reference_policy(name)
    offsets = rng.uniform(-OFFSET, OFFSET, (OFFSETS, KNOTS, actions)).astype(np.float32)
    changes = []
    for places, scenario in zip(offsets, first_of(POOL, len(offsets), skip=920_000), strict=True):

        def act(observation: Float32Array, places: Float32Array = places) -> Float32Array:
            return policy.mean(observation) + _offset(places, 1.0 - float(observation[-1]))

        usual, other = (_sums(_driven(name, each, (scenario,)))[0] for each in (policy.mean, act))
        changes.append(other - usual)
    measured = np.array(changes) / (np.std(changes, axis=0) + 1e-9)
    flat = offsets.reshape(len(offsets), -1)
    fitted = np.linalg.solve(flat.T @ flat + 1e-2 * len(flat) * np.eye(flat.shape[1]), flat.T @ measured)
    explained = 1.0 - (measured - flat @ fitted).var() / measured.var()
    sys.stdout.write(f"{name}: offsets explain {explained:.0%} of what a pool of them differs by\n")
    directions = np.linalg.svd(fitted.T, full_matrices=False)[2][:LEARNED].reshape(-1, KNOTS, actions)
    directions = (OFFSET * directions / np.abs(directions).max(axis=(1, 2), keepdims=True)).astype(np.float32)

    def changed(seen: Float32Array, coordinates: FloatArray, action: Float32Array) -> Float32Array:
        places = np.tensordot(coordinates.astype(np.float32), directions, 1)
        moved: Float32Array = action + _offset(places, 1.0 - float(seen[-1]))
        return moved

    return changed


if __name__ == "__main__":
    main()
