"""What the server that forks the compute processes imports once, for all of them: they begin at once and share it."""

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"  # read while the libraries below are loaded; more processes do better than more threads

from worker.compute import baseline_fitting, filter_fitting, learning, simulation  # noqa: E402  (after the above)
from worker.ml.rewards import reward_training  # noqa: E402  (what learning imports where it is used)

__all__ = ["baseline_fitting", "filter_fitting", "learning", "reward_training", "simulation"]
