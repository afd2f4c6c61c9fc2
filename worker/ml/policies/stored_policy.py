"""Any frozen policy as the bytes of policy.onnx."""

from worker.ml.policies.asked_policy import AskedPolicy
from worker.ml.policies.onnx_policy import OnnxPolicy
from worker.ml.policies.policy_onnx import policy_to_onnx
from worker.ml.policies.reference import ReferencePolicy


class NotStored(ValueError):
    """The task's policy is no file of which a blinded controller could be made: it answers from a server or function.
    Leave evaluations out, or name the policy as a file in lab.toml."""


def stored_policy(policy: ReferencePolicy) -> bytes:
    """observation (batch, D) -> policy_mean (batch, A): written from its weights, or the graph that it is.

    Raises NotStored.
    """
    if isinstance(policy, AskedPolicy):
        raise NotStored(" ".join(str(NotStored.__doc__).split()))
    return policy.stored if isinstance(policy, OnnxPolicy) else policy_to_onnx(policy)
