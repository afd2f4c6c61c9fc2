"""Which scenarios (environment seeds) serve which purpose: nothing is judged on what it was fitted to.

The web server draws from the two of the evaluation, which app.services.evaluation.evaluation_plan defines; a test holds
all of them apart.
"""

RESPONSE_SURFACE = range(100_000, 150_000)
"""Random modes, from which the response surface is fitted."""
RESPONSE_SURFACE_SOUGHT = range(150_000, 190_000)
"""Modes that somebody would want, with which it is refined."""
MODE_ARCHIVE = range(190_000, 200_000)
"""Modes that somebody would want, each in all of them."""
SIGNAL_PREDICTOR = range(200_000, 250_000)
SIGNAL_PREDICTOR_TEST = range(250_000, 300_000)
POLICY_TRAINING = range(300_000, 1_000_000)
"""Demonstrations and pre-training. (The policies that ship with version 0.1 were trained in 0 to 999 999.)"""
POLICY_TEST = range(1_000_000, 1_500_000)
POLICY_SELECTION = range(1_500_000, 2_000_000)
"""Which state of a pre-training is kept. (Of those that ship with version 0.1 in those of the gate.)"""
GATE = range(2_000_000, 3_000_000)
"""Whether a mode or residual is accepted."""
RESIDUAL = range(3_000_000, 4_000_000)
"""Rollouts from which the residual and the printed encoder learn."""
EVALUATION = range(4_000_000, 5_000_000)
"""What is reported of a filter."""
PREVIEW = range(6_900_000, 7_000_000)
"""What people watch who set a robot themselves. Every study has one."""
PROMISE = range(7_000_000, 9_000_000)
"""Whether the promise about harm can be made of a filter. Every study has its own."""
PROMISE_TEST = range(9_000_000, 10_000_000)
"""Whether such promises were kept."""
POOL = range(10_000_000, 100_000_000)
"""Clips of studies, and the pools of scripted users."""
NORMALISATION = range(2_000_000_000, 2_000_001_000)
"""Over which reward models have mean 0 and deviation 1."""

_POOL_OF_A_STUDY = 1_000
MADE_FROM = 500
"""Of a study's thousand: from here on what is made for one person; a pool has at most as many scenarios."""
MOST_MADE = _POOL_OF_A_STUDY - MADE_FROM
_PROMISE_OF_A_STUDY = 4_000


def first_of(block: range, count: int, skip: int = 0) -> range:
    """So many scenarios of a block, after ``skip`` others. Raises ValueError when it has not enough."""
    if not 0 <= skip <= len(block) - count:
        raise ValueError(f"There are only {len(block)} scenarios from {block.start} on, not {skip + count}.")
    return block[skip : skip + count]


def of_pool(study_seed: int, index: int) -> int:
    """The scenario at one place of a study's pool."""
    pools = len(POOL) // _POOL_OF_A_STUDY
    return POOL.start + study_seed % pools * _POOL_OF_A_STUDY + index


def of_made(study_seed: int, number: int) -> int:
    """The scenario of the pair with this number that is made for somebody: the same for everybody in the study.

    Raises ValueError from MOST_MADE on.
    """
    if not 0 <= number < MOST_MADE:
        raise ValueError(f"At most {MOST_MADE} pairs are made for one person.")
    return of_pool(study_seed, MADE_FROM + number)


def of_preview(study_seed: int) -> int:
    """The scenario of a study's previews."""
    return PREVIEW[study_seed % len(PREVIEW)]


def of_promise(study_seed: int) -> range:
    """A study's scenarios of the promise."""
    blocks = len(PROMISE) // _PROMISE_OF_A_STUDY
    return first_of(PROMISE, _PROMISE_OF_A_STUDY, skip=study_seed % blocks * _PROMISE_OF_A_STUDY)
