"""Makes policy.onnx: a small network that imitates a proportional controller of the hand, in a few seconds.

    python examples/reach/train_policy.py

The observation is PandaReach's Dict, flattened in the order of its keys: achieved_goal, desired_goal, observation.
"""

from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

SIZE, ACTIONS, HIDDEN, STEPS = 12, 3, 24, 3000
FASTEST = 1.0


def controller(observations: torch.Tensor) -> torch.Tensor:
    """Towards the goal, as fast as the arm can until it is near. (N, 12) -> (N, 3)"""
    way = observations[:, 3:6] - observations[:, 0:3]
    distance = way.norm(dim=1, keepdim=True).clamp_min(1e-6)
    return FASTEST * way / distance * (distance / 0.06).clamp_max(1.0)


def train() -> list[torch.nn.Linear]:
    """Behaviour cloning on places drawn at random in the arm's workspace."""
    torch.manual_seed(0)
    layers = [torch.nn.Linear(SIZE, HIDDEN), torch.nn.Linear(HIDDEN, HIDDEN), torch.nn.Linear(HIDDEN, ACTIONS)]
    network = torch.nn.Sequential(layers[0], torch.nn.Tanh(), layers[1], torch.nn.Tanh(), layers[2], torch.nn.Tanh())
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        observations = torch.zeros(512, SIZE)
        observations[:, 3:6] = torch.rand(512, 3) * 0.3 - torch.tensor([0.15, 0.15, 0.0])
        way = torch.randn(512, 3) * 0.12 * torch.rand(512, 1)
        observations[:, 0:3] = observations[:, 3:6] - way
        observations[:, 6:9] = observations[:, 0:3]
        observations[:, 9:12] = 0.3 * torch.randn(512, 3)
        loss = ((network(observations) - controller(observations)) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return layers


def write(layers: list[torch.nn.Linear], file: Path) -> None:
    """The network as ONNX, node by node."""
    nodes, constants, name = [], [], "observation"
    for index, layer in enumerate(layers):
        arrays = {f"weight_{index}": layer.weight, f"bias_{index}": layer.bias}
        constants += [
            numpy_helper.from_array(each.detach().numpy().astype(np.float32), key) for key, each in arrays.items()
        ]
        nodes.append(helper.make_node("Gemm", [name, *arrays], [f"raw_{index}"], transB=1))
        name = "action" if index + 1 == len(layers) else f"hidden_{index}"
        nodes.append(helper.make_node("Tanh", [f"raw_{index}"], [name]))
    ends = [("observation", SIZE), ("action", ACTIONS)]
    values = [helper.make_tensor_value_info(key, TensorProto.FLOAT, ["batch", size]) for key, size in ends]
    graph = helper.make_graph(nodes, "policy", values[:1], values[1:], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model)
    file.write_bytes(model.SerializeToString(deterministic=True))


if __name__ == "__main__":
    write(train(), Path(__file__).with_name("policy.onnx"))
