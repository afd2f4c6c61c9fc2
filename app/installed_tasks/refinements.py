"""What both programs know of refinements (worker.ml.reinforcement.refinement): how long, and what is done ahead."""

SHORTEST_REFINEMENT = 8_000
"""Environment steps; half of them are the filter's own, before anything is learned."""
SHARE_AHEAD = 0.9
"""of the steps, made while the person still answers"""
ANSWERS_AHEAD = 50
"""which that part follows; with 25 of a hundred less was gained (docs/results/how_the_refinement_was_found.md)"""


def none_or_enough(steps: int) -> int:
    """Environment steps of a refinement. Raises ValueError for so few that nothing would be learned."""
    if 0 < steps < SHORTEST_REFINEMENT:
        raise ValueError(f"must be 0, for none, or at least {SHORTEST_REFINEMENT:,}")
    return steps


def answers_ahead(labels: int) -> int:
    """How many of a person's answers a refinement follows as far as it is made ahead: half of them at most."""
    return min(labels // 2, ANSWERS_AHEAD)
