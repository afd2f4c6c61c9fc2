"""Which execution modes are filmed ahead for people who set a robot themselves."""

from itertools import product

import numpy as np
import numpy.typing as npt

from worker.domain.modes import ModeFamily

COUNT = 64
_CANDIDATES = 512
"""Random modes among which each further film is the one farthest from all films so far."""
_DRAWN_FROM = 11
"""The same films in every study of a task."""


def modes(family: ModeFamily, count: int = COUNT) -> npt.NDArray[np.float64]:
    """The modes to film, (count, A), in the order of filming.

    First the reference policy's own way, then every axis alone at its ends and halfway to them, because people move one
    slider at a time; the rest fills the space (farthest-point sampling: Gonzalez 1985, Theoretical Computer Science 38,
    293-306), with every axis in shares of its range.
    """
    low, high = (np.array([getattr(axis, end) for axis in family.axes]) for end in ("low", "high"))
    width = np.where(high > low, high - low, 1.0)
    films = [family.reference]
    for share, index, end in product((1.0, 0.5), range(len(family.axes)), (low, high)):
        if end[index] != 0.0:
            films.append(np.where(np.arange(len(end)) == index, share * end, 0.0))
    rng = np.random.default_rng(_DRAWN_FROM)
    candidates = rng.uniform(low, high, (_CANDIDATES, len(low)))
    nearest = np.min([np.linalg.norm((candidates - film) / width, axis=1) for film in films], axis=0)
    while len(films) < count:
        films.append(candidates[np.argmax(nearest)])
        nearest = np.minimum(nearest, np.linalg.norm((candidates - films[-1]) / width, axis=1))
    return np.array(films[:count])
