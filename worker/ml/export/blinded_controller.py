"""Any method as one ONNX model, observation -> action, that does not say which method it is.

Whoever runs the robot in a blinded comparison gets such models by letter only. Names, comments and producer are removed
from the graph and every file is made equally long. That protects from knowing by accident: somebody who opens the
graph, or times it, can still tell a plain policy from a filter around one.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import ModelProto, NodeProto, TensorProto, helper

from worker.domain.task import Task
from worker.domain.type_aliases import Act, Float32Array
from worker.ml.export import run_controller
from worker.ml.export.bundle import described_space
from worker.ml.export.run_controller import INPUT, OUTPUT, Controller
from worker.ml.filters.exported.filter_act import FilterAct
from worker.ml.filters.exported.filter_onnx import LARGEST_DIFFERENCE, ExportDiffers, OnnxFilter
from worker.ml.policies.asked_policy import AskedPolicy
from worker.ml.policies.policy_onnx import IR_VERSION, OPSET
from worker.ml.policies.reference import ReferencePolicy
from worker.ml.policies.stored_policy import stored_policy
from worker.ml.reinforcement.preference_rl import PolicyAct

SCHEMA_VERSION = 1
LENGTH_BYTES = 1 << 20
"""Models are padded to a multiple of this: all methods so far need less than half of it."""
_TIMESTAMP = (1980, 1, 1, 0, 0, 0)
_POLICY_MEAN = "policy_mean"
_ASKED = "asked"
"""Which of several policy servers; such controllers are never given to an operator."""


class NotExportable(TypeError):
    """This method cannot be written as a controller."""


@dataclass(frozen=True)
class Blinded:
    """One controller as its operator gets it; ``participant`` is a pseudonym such as P07."""

    task: Task
    study: str
    participant: str
    letter: str
    model: bytes
    observations: Float32Array
    """(N, D) for checking the file elsewhere; the same for every letter"""


def of_act(act: Act, observations: Float32Array) -> bytes:
    """A fitted method as one ONNX model, compared with the method itself in these observations, (N, D).

    Where the policy answers from a server, the model has what the server says as another input. Raises NotExportable
    for a method that is neither a policy nor a filter around one, and ExportDiffers.
    """
    if isinstance(act, PolicyAct):
        stored = _of_policy(act.policy)
    elif isinstance(act, FilterAct):
        stored = _of_filter(act)
    else:
        raise NotExportable(f"{type(act).__name__} cannot be written as a controller.")
    _compare(stored, act, observations)
    return stored


def act_of_stored(stored: bytes, policy_named: Callable[[str], ReferencePolicy]) -> Act:
    """What of_act() has written, as a rollout's callable. ``policy_named``: the one to be asked, where it answers from
    a server; the empty name is the frozen one's."""
    model = onnx.load_from_string(stored)
    if _POLICY_MEAN not in {each.name for each in model.graph.input}:
        return Controller(stored)
    asked = {each.key: each.value for each in model.metadata_props}.get(_ASKED, "")
    return FilterAct(policy_named(asked), OnnxFilter(stored))


def write(blinded: Blinded) -> bytes:
    """The zip file an operator downloads: model, recording, manifest, and a script that needs no other software.

    The same contents give the same bytes; nothing is compressed, so that the length does not depend on the method.
    """
    actions = Controller(blinded.model).batch(blinded.observations)
    files = {
        "controller.onnx": blinded.model,
        "run_controller.py": Path(run_controller.__file__).read_bytes(),
        "recorded/observations.npy": _npy(blinded.observations),
        "recorded/actions.npy": _npy(actions),
    }
    manifest = _manifest(blinded) | {
        "files": {
            name: {"bytes": len(stored), "sha256": hashlib.sha256(stored).hexdigest()}
            for name, stored in sorted(files.items())
        }
    }
    files["manifest.json"] = (json.dumps(manifest, indent=2, sort_keys=True, allow_nan=False) + "\n").encode()
    return _zipped(files)


def _manifest(blinded: Blinded) -> dict[str, Any]:
    return {
        "schema_version": SCHEMA_VERSION,
        "study": blinded.study,
        "participant": blinded.participant,
        "letter": blinded.letter,
        "task": blinded.task.name,
        "control_rate_hz": round(1.0 / blinded.task.control_step_s, 6),
        "observation": described_space(blinded.task.observation),
        "action": described_space(blinded.task.action),
        "onnx": {
            "file": "controller.onnx",
            "input": {"name": INPUT, "type": "float32", "shape": ["batch", blinded.task.observation.size]},
            "output": {"name": OUTPUT, "type": "float32", "shape": ["batch", blinded.task.action.size]},
        },
    }


def _of_policy(policy: ReferencePolicy) -> bytes:
    """The policy's graph; of a server nothing but what it says."""
    if isinstance(policy, AskedPolicy):
        said = helper.make_node("Identity", [_POLICY_MEAN], [OUTPUT])
        return _blinded([said], [], _SAID, (OPSET, IR_VERSION), policy)
    graph = onnx.load_from_string(stored_policy(policy))
    return _blinded([*graph.graph.node], graph.graph.initializer, {_POLICY_MEAN: OUTPUT}, _versions(graph), policy)


def _of_filter(act: FilterAct) -> bytes:
    """The policy's graph, and the filter's behind it."""
    if isinstance(act.policy, AskedPolicy):
        alone = onnx.load_from_string(act.exported.stored)
        return _blinded([*alone.graph.node], alone.graph.initializer, _SAID, _versions(alone), act.policy)
    policy = onnx.load_from_string(stored_policy(act.policy))
    filtering = onnx.load_from_string(act.exported.stored)
    mean = {_POLICY_MEAN: f"policy/{_POLICY_MEAN}"}
    nodes = [*_renamed(policy, "policy", {INPUT: INPUT}), *_renamed(filtering, "filter", {**_ENDS, **mean})]
    constants = [each for model in (policy, filtering) for each in model.graph.initializer]
    return _blinded(nodes, constants, {}, _versions(filtering), act.policy)


_ENDS = {INPUT: INPUT, OUTPUT: OUTPUT}
_SAID = {_POLICY_MEAN: _POLICY_MEAN}
"""What a server says goes in as it is."""


def _versions(model: ModelProto) -> tuple[int, int]:
    """Of the operators and of the format."""
    return max(each.version for each in model.opset_import if each.domain == ""), model.ir_version


def _renamed(model: ModelProto, prefix: str, kept: dict[str, str]) -> list[NodeProto]:
    """The nodes, every name in them (and in the initializers) behind a prefix, except those that are kept."""

    def new(name: str) -> str:
        return name and kept.get(name, f"{prefix}/{name}")

    for constant in model.graph.initializer:
        constant.name = new(constant.name)
    for node in model.graph.node:
        for names in (node.input, node.output):
            names[:] = [new(name) for name in names]
    return list(model.graph.node)


def _blinded(
    nodes: list[NodeProto],
    constants: Iterable[TensorProto],
    named: dict[str, str],
    versions: tuple[int, int],
    policy: ReferencePolicy,
) -> bytes:
    """A model of these nodes in which every name is a number. ``named``: values that become input or output."""
    numbers: dict[str, str] = {**_ENDS, **named}

    def number(name: str) -> str:
        return name and numbers.setdefault(name, f"v{len(numbers)}")

    plain = [
        helper.make_node(node.op_type, [number(each) for each in node.input], [number(each) for each in node.output])
        for node in nodes
    ]
    for node, written in zip(nodes, plain, strict=True):
        written.attribute.extend(node.attribute)
    tensors = []
    for constant in constants:
        tensor = TensorProto()
        tensor.CopyFrom(constant)
        tensor.name, tensor.doc_string = number(constant.name), ""
        tensors.append(tensor)
    sizes = {INPUT: len(policy.offset), OUTPUT: policy.action_size, _POLICY_MEAN: policy.action_size}
    ends = {
        name: helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size]) for name, size in sizes.items()
    }
    inputs = [ends[INPUT], *([ends[_POLICY_MEAN]] if isinstance(policy, AskedPolicy) else [])]
    graph = helper.make_graph(plain, "controller", inputs, [ends[OUTPUT]], tensors)
    opset, ir_version = versions
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=ir_version)
    onnx.checker.check_model(model)
    if isinstance(policy, AskedPolicy) and policy.asking.name:
        model.metadata_props.add(key=_ASKED, value=policy.asking.name)
    return _padded(model)


def _padded(model: ModelProto) -> bytes:
    """Exactly a multiple of LENGTH_BYTES: a note of noughts fills what is missing."""
    entry = model.metadata_props.add(key="padding", value="")
    needed = model.ByteSize() + 16  # what the length of the note itself may take
    goal = -(-needed // LENGTH_BYTES) * LENGTH_BYTES
    entry.value = "0" * (goal - needed)
    entry.value += "0" * (goal - model.ByteSize())
    stored: bytes = model.SerializeToString(deterministic=True)
    return stored


def _compare(stored: bytes, act: "PolicyAct | FilterAct", observations: Float32Array) -> None:
    expected = np.array([act(each) for each in observations]).clip(-1.0, 1.0)
    written = act_of_stored(stored, lambda _: act.policy)
    said = np.array([written(each) for each in observations])
    difference = float(np.abs(said - expected).max())
    if not difference <= LARGEST_DIFFERENCE:
        raise ExportDiffers(f"{ExportDiffers.__doc__} The largest difference is {difference:.1e}.")


def _npy(array: Float32Array) -> bytes:
    target = io.BytesIO()
    np.save(target, np.ascontiguousarray(array, np.float32), allow_pickle=False)
    return target.getvalue()


def _zipped(files: dict[str, bytes]) -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(files):
            entry = zipfile.ZipInfo(name, _TIMESTAMP)
            entry.create_system = 3  # Unix, wherever it is written
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, files[name])
    return target.getvalue()
