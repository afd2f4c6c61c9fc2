"""The frozen policies there are: the studio's own Gaussian network, and graphs and servers of laboratories."""

from typing import TYPE_CHECKING, TypeAlias

from worker.ml.policies.gaussian import GaussianPolicy

if TYPE_CHECKING:  # its runtime is loaded by whoever needs it
    from worker.ml.policies.asked_policy import AskedPolicy
    from worker.ml.policies.onnx_policy import OnnxPolicy

ReferencePolicy: TypeAlias = "GaussianPolicy | OnnxPolicy | AskedPolicy"


class NotLookedInto(ValueError):
    """This method needs the policy's own weights; a laboratory's policy is only asked what it does. Take another."""


def looked_into(policy: ReferencePolicy) -> GaussianPolicy:
    """The policy as a network that is known. Raises NotLookedInto."""
    if not isinstance(policy, GaussianPolicy):
        raise NotLookedInto(NotLookedInto.__doc__)
    return policy
