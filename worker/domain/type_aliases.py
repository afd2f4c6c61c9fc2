"""Types that many modules share."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

Float32Array = npt.NDArray[np.float32]
"""What policies, networks and trajectories hold."""
FloatArray = npt.NDArray[np.float64]
"""What physics and statistics compute with."""

Act = Callable[[Float32Array], Float32Array]
"""A policy as a rollout asks it: observation (D,) -> action (7,)."""
