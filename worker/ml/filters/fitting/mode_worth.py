"""What a mode that is sought may lose of success, and what more of it costs."""

import numpy as np

from worker.domain.type_aliases import FloatArray

SUCCESS_TOLERANCE = 0.015
SUCCESS_PENALTY = 20.0
"""Standard deviations of predicted return per unit of success lost beyond the tolerance."""


def price_of_failures(success: FloatArray, penalty: float = SUCCESS_PENALTY) -> FloatArray:
    """(...) changes of the chance of success -> what is taken off modes' returns, in their standard deviations."""
    return penalty * np.maximum(-success - SUCCESS_TOLERANCE, 0.0)
