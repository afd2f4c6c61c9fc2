"""The frozen reference policy's mean as an ONNX file: with it a bundle turns observations into actions on its own."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from worker.ml.policies.gaussian import LAYERS, GaussianPolicy

INPUT, OUTPUT = "observation", "policy_mean"
OPSET = 18
IR_VERSION = 10


def policy_to_onnx(policy: GaussianPolicy) -> bytes:
    """observation (batch, D) -> policy_mean (batch, 7), written node by node: a dozen operations need no tracing."""
    weights = {name: np.asarray(array, np.float32) for name, array in policy.weights.items()}
    last = LAYERS - 1
    # The second half of the last layer is the log standard deviation, which the mean action does not need.
    weights[f"weight_{last}"] = weights[f"weight_{last}"][:, : policy.action_size]
    weights[f"bias_{last}"] = weights[f"bias_{last}"][: policy.action_size]
    weights["limit"] = np.array([policy.action_limit], np.float32)
    nodes = [
        helper.make_node("Sub", [INPUT, "offset"], ["centred"]),
        helper.make_node("Mul", ["centred", "scale"], ["hidden_0"]),
    ]
    for layer in range(LAYERS):
        inputs = [f"hidden_{layer}", f"weight_{layer}", f"bias_{layer}"]
        nodes.append(helper.make_node("Gemm", inputs, [f"raw_{layer}"]))
        if layer < last:
            nodes.append(helper.make_node("Relu", [f"raw_{layer}"], [f"hidden_{layer + 1}"]))
    nodes.append(helper.make_node("Tanh", [f"raw_{last}"], ["squashed"]))
    nodes.append(helper.make_node("Mul", ["squashed", "limit"], [OUTPUT]))
    used = {name for node in nodes for name in node.input}
    graph = helper.make_graph(
        nodes,
        "reference_policy",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["batch", len(weights["offset"])])],
        [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["batch", policy.action_size])],
        [numpy_helper.from_array(array, name) for name, array in sorted(weights.items()) if name in used],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    onnx.checker.check_model(model)
    stored: bytes = model.SerializeToString(deterministic=True)
    return stored
