"""Archived policies in modes: which mode is best for a person, and trials that end where no more than losing is left.

Most modes that are wanted lose the task in one or two of the gate's scenarios, and mostly in the same: what has been
lost before is driven first.
"""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, FloatArray
from worker.ml.filters.fitting.filter_draft import GateTrial
from worker.ml.filters.fitting.filter_problem import Collect, FilterProblem
from worker.ml.filters.fitting.gate import largest_forces, pressed_in, signal_changes, successes
from worker.ml.filters.fitting.mode_archive import tail_growth_n
from worker.ml.filters.fitting.mode_search import caution_of
from worker.ml.filters.fitting.response_surface import ResponseSurface, best_mode

DRIVEN_FIRST = 6
"""of the scenarios in which modes have lost most often"""


class Lost(NamedTuple):
    """Beside the reference policy, in the same scenarios."""

    failed: int
    """more failures; below 0: fewer"""
    pressed: int
    """episodes in which somebody is pressed much harder"""

    @classmethod
    def of(cls, problem: FilterProblem, reference: Sequence[Trajectory], driven: Sequence[Trajectory]) -> "Lost":
        """What rollouts lose, scenario by scenario."""
        failed = successes(reference).sum() - successes(driven).sum()
        return cls(round(float(failed)), int(pressed_in(problem, reference, driven).sum()))

    def exceeds(self, alone: "Lost") -> bool:
        """Whether it is more than by the policy alone, and than by the reference policy: no mode has to win back."""
        return self.failed > max(0, alone.failed) or self.pressed > alone.pressed


class DoubtedFirst:
    """Drives modes through the gate's scenarios, and leaves off where one has lost more than can be won back."""

    def __init__(self, problem: FilterProblem, reference: Sequence[Trajectory], collect: Collect) -> None:
        self.problem, self.reference, self.collect = problem, reference, collect
        self.winnable = [place for place, each in enumerate(reference) if not each.success]
        self.lost_in = Counter[int]()

    def drive(self, act: Act, alone: Lost) -> Sequence[Trajectory] | None:
        """The rollouts; None: it loses more than ``alone``, whatever it does in scenarios that are not driven.

        There the reference policy does the task, so that nothing is won.
        """
        doubted = [place for place, _ in self.lost_in.most_common(DRIVEN_FIRST)]
        first = sorted({*self.winnable, *doubted})
        driven = self._drive(act, first)
        if self._lost(driven).exceeds(alone):
            return None
        driven |= self._drive(act, [place for place in range(len(self.reference)) if place not in driven])
        if self._lost(driven).exceeds(alone):
            self.lost_in.update(place for place in driven if any(count > 0 for count in self._lost(driven, place)))
        return [driven[place] for place in range(len(self.reference))]

    def _drive(self, act: Act, places: Sequence[int]) -> dict[int, Trajectory]:
        if not places:
            return {}
        scenarios = [self.reference[place].scenario for place in places]
        return dict(zip(places, self.collect(act, scenarios, 0.0, self.problem.seed), strict=True))

    def _lost(self, driven: dict[int, Trajectory], *places: int) -> Lost:
        """In these of the places that were driven, or in all."""
        of = places or tuple(driven)
        return Lost.of(self.problem, [self.reference[place] for place in of], [driven[place] for place in of])


class InModes:
    """An archived policy, and which mode is best for it by all that is known of those around it."""

    def __init__(
        self,
        problem: FilterProblem,
        driven: Sequence[Trajectory],
        around: ResponseSurface,
        trial: GateTrial,
        wishes: FloatArray,
        reference: Sequence[Trajectory],
        archived: Sequence[tuple[FloatArray, Sequence[Trajectory]]] = (),
    ) -> None:
        """``driven``, ``trial``: of the policy as it is; ``wishes``: (E, S) in the unit of the trial's preference.

        ``reference``: rollouts of the frozen policy; ``archived``: of this one in modes that are archived.
        """
        self.problem, self.driven, self.trial, self.wishes = problem, driven, trial, wishes
        self.reference, self.surface, self.forces = reference, around, around.forces
        self.lost, self.tried = 0, list[FloatArray]()
        for mode, rollouts in archived:
            self._learn(mode, rollouts)
        self._seek()

    def observe(self, driven: Sequence[Trajectory], *, is_kept: bool) -> None:
        """Learn from what came of the mode in the gate's scenarios, and seek another."""
        self._learn(self.mode, driven)
        self._seek_beside(is_kept=is_kept)

    def give_up(self) -> None:
        """Of a mode no more is known than that it loses too much: seek another."""
        self._seek_beside(is_kept=False)

    def _learn(self, mode: FloatArray, driven: Sequence[Trajectory]) -> None:
        changes = signal_changes(self.driven, driven)
        self.surface = self.surface.with_observed(mode, changes, successes(driven))
        growth_n = tail_growth_n(largest_forces(driven) - largest_forces(self.reference))
        self.forces = self.forces.with_observed(mode, float(growth_n))

    def _seek_beside(self, *, is_kept: bool) -> None:
        self.tried.append(self.mode)
        self.lost += not is_kept
        self._seek()

    def _seek(self) -> None:
        """More carefully about success, the more were tried that lost too much."""
        self.mode = best_mode(
            self.surface,
            self.wishes,
            self.problem.seed,
            caution=caution_of(self.problem),
            success_caution=self.problem.config.success_caution * (1 + self.lost),
            forces=self.forces,
            most_growth_n=self.problem.config.pressed_n,
        )
        is_new = self.mode.any() and not any(np.array_equal(self.mode, tried) for tried in self.tried)
        gained = float(self.surface.predict(self.mode)[0] @ self.wishes.mean(axis=0))
        self.foreseen = self.trial.preference + gained if is_new else -np.inf
