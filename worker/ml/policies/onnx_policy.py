"""A frozen policy of which only what it says is known: an ONNX graph, from observation to mean action in [-1, 1]."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

from worker.domain.type_aliases import Float32Array, FloatArray
from worker.ml.policies.policy_onnx import INPUT, IR_VERSION, OPSET, OUTPUT


class NotAPolicy(ValueError):
    """A file is not a policy for this environment; the message says why and what to do."""


class OnnxPolicy:
    """observation (batch, D) -> policy_mean (batch, A). Travels between processes as its bytes."""

    action_limit = 1.0

    def __init__(self, stored: bytes, observation_size: int) -> None:
        self.stored = stored
        self._size = observation_size

    def __reduce__(self) -> tuple[Any, ...]:
        """A session of the runtime stays where it is."""
        return type(self), (self.stored, self._size)

    @property
    def weights(self) -> dict[str, Float32Array]:
        """The graph as it is, for its hash."""
        return {"graph": np.frombuffer(self.stored, np.uint8).astype(np.float32)}

    @property
    def offset(self) -> Float32Array:
        """(D,) Observations are not normalised outside of the graph."""
        return np.zeros(self._size, np.float32)

    @property
    def scale(self) -> Float32Array:
        """(D,)"""
        return np.ones(self._size, np.float32)

    @property
    def action_size(self) -> int:
        """A"""
        return int(onnx.load_from_string(self.stored).graph.output[0].type.tensor_type.shape.dim[1].dim_value)

    def mean(self, observations: Float32Array) -> Float32Array:
        """(..., D) -> (..., A)"""
        rows = np.ascontiguousarray(np.reshape(observations, (-1, self._size)), np.float32)
        (said,) = self._session.run([OUTPUT], {INPUT: rows})
        return np.asarray(said, np.float32).reshape(*np.shape(observations)[:-1], -1)

    @cached_property
    def _session(self) -> Any:
        return session(self.stored)


def session(stored: bytes) -> Any:
    """A runtime on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what is wrong is raised
    return onnxruntime.InferenceSession(stored, options, providers=["CPUExecutionProvider"])


def said_by_file(size: int, actions: int, settings: Mapping[int, float]) -> list[int]:
    """Which actions a policy's output of this size is: all of them, or those that are no settings.

    Raises NotAPolicy when it is neither.
    """
    free = [place for place in range(actions) if place not in settings]
    if size not in (0, actions, len(free)):
        without = f", or {len(free)} without its settings" if settings else ""
        raise NotAPolicy(f"its output has {size} numbers, but its actions has {actions}{without}.")
    return free if size == len(free) else list(range(actions))


def adapted(
    stored: bytes,
    own_size: int,
    observation_size: int,
    bounds: tuple[FloatArray, FloatArray],
    gain: float | FloatArray,
    settings: Mapping[int, float] = MappingProxyType({}),
) -> OnnxPolicy:
    """A laboratory's graph as a policy of the studio's.

    It is given the first ``own_size`` numbers of an observation; its actions, in the environment's own unit with these
    bounds (A,), are mapped to [-1, 1] and multiplied by ``gain``, one number or (A,). ``settings``: actions that stay
    at a value in the environment's own unit, whatever the graph says of them, if it says anything. Raises NotAPolicy.
    """
    try:
        model = onnx.load_from_string(stored)
        onnx.checker.check_model(model)
        session(stored)
    except Exception as error:  # the libraries raise many kinds
        raise NotAPolicy(
            f"it cannot be read as ONNX ({_short(error)}). Export it again, weights inside the file."
        ) from error
    constants = {each.name for each in model.graph.initializer}
    inputs = [each for each in model.graph.input if each.name not in constants]
    if len(inputs) != 1:
        raise NotAPolicy(
            f"its graph has {len(inputs)} inputs ({', '.join(each.name for each in inputs)}); it must have one, the "
            "observation as one vector, a Dict's parts in the order of their keys."
        )
    _require_shape("input", inputs[0], own_size, "the environment's observation")
    low, high = bounds
    count = len(low)
    output = model.graph.output[0].type.tensor_type.shape.dim
    own = said_by_file(output[1].dim_value if len(output) == 2 else 0, count, settings)
    _require_shape("output", model.graph.output[0], len(own), "its actions")
    middle, half = (high + low) / 2.0, (high - low) / 2.0
    placed = np.eye(count)[own] * [place not in settings for place in range(count)]
    constant = np.array(
        [(settings[place] - middle[place]) / half[place] if place in settings else 0.0 for place in range(count)]
    )
    if np.abs(constant).max() > 1.0 + 1e-6:
        raise NotAPolicy("one of its settings is outside of the environment's own bounds of that action.")
    ends: dict[str, npt.NDArray[Any]] = {
        "first": np.array([0], np.int64),
        "last": np.array([own_size], np.int64),
        "axis": np.array([1], np.int64),
        "middle": middle[own].astype(np.float32),
        "half": half[own].astype(np.float32),
        "gain": np.unique(gain).astype(np.float32) if np.ptp(gain) == 0.0 else np.asarray(gain, np.float32)[own],
        "least": np.array(-1.0, np.float32),
        "most": np.array(1.0, np.float32),
    }
    _rename(model.graph, {inputs[0].name: "lab/own", model.graph.output[0].name: "lab/action"})
    nodes = [
        helper.make_node("Slice", [INPUT, "first", "last", "axis"], ["lab/own"]),
        *model.graph.node,
        helper.make_node("Sub", ["lab/action", "middle"], ["centred"]),
        helper.make_node("Div", ["centred", "half"], ["unit"]),
        helper.make_node("Clip", ["unit", "least", "most"], ["bounded"]),
        helper.make_node("Mul", ["bounded", "gain"], ["slowed" if settings else OUTPUT]),
    ]
    if settings:
        ends |= {"placed": placed.astype(np.float32), "settings": constant.astype(np.float32)}
        nodes += [
            helper.make_node("MatMul", ["slowed", "placed"], ["free"]),
            helper.make_node("Add", ["free", "settings"], [OUTPUT]),
        ]
    graph = helper.make_graph(
        nodes,
        "lab_policy",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["batch", observation_size])],
        [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["batch", len(low)])],
        [*model.graph.initializer, *(numpy_helper.from_array(array, name) for name, array in ends.items())],
    )
    opsets = [each for each in model.opset_import if each.domain not in ("", "ai.onnx")]
    version = max([OPSET, *(each.version for each in model.opset_import if each.domain in ("", "ai.onnx"))])
    if any(each.version < 13 for each in model.opset_import if each.domain in ("", "ai.onnx")):
        raise NotAPolicy("its opset is older than 13. Export it again with opset_version=18.")
    joined = helper.make_model(
        graph, functions=model.functions, opset_imports=[helper.make_opsetid("", version), *opsets]
    )
    joined.ir_version = max(IR_VERSION, model.ir_version)
    written: bytes = joined.SerializeToString(deterministic=True)
    policy = OnnxPolicy(written, observation_size)
    try:
        said = policy.mean(np.zeros((2, observation_size), np.float32))
    except Exception as error:
        raise NotAPolicy(
            f"it does not run on two observations at once ({_short(error)}). Export it with a free batch size."
        ) from error
    if said.shape != (2, len(low)) or not np.isfinite(said).all():
        raise NotAPolicy(f"for two observations of zeros it says {said.tolist()}, not two rows of {len(low)} numbers.")
    return policy


def mlp_to_onnx(layers: Sequence[tuple[Float32Array, Float32Array]], activation: str, squash: str) -> bytes:
    """A plain network, observation (batch, D) -> action (batch, A), written node by node.

    ``layers``: weights (out, in) and biases (out,) as torch has them; ``activation``: an operation of ONNX between
    them; ``squash``: one after the last, or empty.
    """
    nodes, constants, name = [], [], INPUT
    for index, (weight, bias) in enumerate(layers):
        constants += [
            numpy_helper.from_array(weight, f"weight_{index}"),
            numpy_helper.from_array(bias, f"bias_{index}"),
        ]
        nodes.append(helper.make_node("Gemm", [name, f"weight_{index}", f"bias_{index}"], [f"raw_{index}"], transB=1))
        name = f"raw_{index}"
        operation = activation if index + 1 < len(layers) else squash
        if operation:
            nodes.append(helper.make_node(operation, [name], [f"hidden_{index}"]))
            name = f"hidden_{index}"
    nodes.append(helper.make_node("Identity", [name], ["action"]))
    graph = helper.make_graph(
        nodes,
        "network",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["batch", layers[0][0].shape[1]])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["batch", layers[-1][0].shape[0]])],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    stored: bytes = model.SerializeToString(deterministic=True)
    return stored


def _rename(graph: onnx.GraphProto, inner: Mapping[str, str]) -> None:
    """Every name, those in branches too, behind a prefix, so that none meets one of ours. Changes the graph."""

    def new(name: str) -> str:
        return name and inner.get(name, f"lab/{name}")

    for named in (*graph.initializer, *graph.input, *graph.output):
        named.name = new(named.name)
    for node in graph.node:
        node.name = ""
        for names in (node.input, node.output):
            names[:] = [new(name) for name in names]
        for attribute in node.attribute:
            for branch in (attribute.g, *attribute.graphs):
                _rename(branch, inner)


def _require_shape(which: str, value: onnx.ValueInfoProto, size: int, what: str) -> None:
    tensor = value.type.tensor_type
    dims = [each.dim_value for each in tensor.shape.dim]
    if tensor.elem_type != TensorProto.FLOAT or len(dims) != 2:
        raise NotAPolicy(f"its {which} {value.name!r} must be float32 of shape (batch, {size}).")
    if dims[1] not in (0, size):
        raise NotAPolicy(f"its {which} {value.name!r} has {dims[1]} numbers, but {what} has {size}.")


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
