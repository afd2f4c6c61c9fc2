"""The frozen policies there are: the studio's own Gaussian network, and graphs of laboratories."""

from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:  # each is loaded by whoever needs it
    from worker.ml.policies.gaussian import GaussianPolicy
    from worker.ml.policies.onnx_policy import OnnxPolicy

ReferencePolicy: TypeAlias = "GaussianPolicy | OnnxPolicy"
