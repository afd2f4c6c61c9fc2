"""Any frozen policy as the bytes of policy.onnx."""

from worker.ml.policies.onnx_policy import OnnxPolicy
from worker.ml.policies.policy_onnx import policy_to_onnx
from worker.ml.policies.reference import ReferencePolicy
from worker.ml.policies.remote_policy import RemotePolicy


class NotStored(ValueError):
    """The task's policy answers from a server: there is no file of it that a blinded controller could be made of. Leave
    evaluations out, or name the policy as a file in lab.toml."""


def stored_policy(policy: ReferencePolicy) -> bytes:
    """observation (batch, D) -> policy_mean (batch, A): written from its weights, or the graph that it is.

    Raises NotStored.
    """
    if isinstance(policy, RemotePolicy):
        raise NotStored(" ".join(str(NotStored.__doc__).split()))
    return policy.stored if isinstance(policy, OnnxPolicy) else policy_to_onnx(policy)
