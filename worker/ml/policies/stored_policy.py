"""Any frozen policy as the bytes of policy.onnx."""

from worker.ml.policies.onnx_policy import OnnxPolicy
from worker.ml.policies.policy_onnx import policy_to_onnx
from worker.ml.policies.reference import ReferencePolicy


def stored_policy(policy: ReferencePolicy) -> bytes:
    """observation (batch, D) -> policy_mean (batch, A): written from its weights, or the graph that it is."""
    return policy.stored if isinstance(policy, OnnxPolicy) else policy_to_onnx(policy)
