"""Any frozen policy as the bytes of policy.onnx."""

from worker.ml.policies.onnx_policy import OnnxPolicy
from worker.ml.policies.policy_onnx import policy_to_onnx
from worker.ml.policies.reference import ReferencePolicy
from worker.ml.policies.remote_policy import RemotePolicy


class NotStored(ValueError):
    """The policy answers from a server: there is no file of it that could be passed on."""


def stored_policy(policy: ReferencePolicy) -> bytes:
    """observation (batch, D) -> policy_mean (batch, A): written from its weights, or the graph that it is. Raises NotStored."""
    if isinstance(policy, RemotePolicy):
        raise NotStored(NotStored.__doc__)
    return policy.stored if isinstance(policy, OnnxPolicy) else policy_to_onnx(policy)
