"""The filter as an ONNX file, checked against torch, and as a fast callable for rollouts."""

import logging
import threading
import warnings
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnx.numpy_helper
import onnx_ir
import onnxruntime
import onnxscript.optimizer
import torch
from onnx_ir.passes.common import ClearMetadataAndDocStringPass

from worker.domain.type_aliases import Float32Array
from worker.ml.filters.exported.filter_module import AnyFilter

INPUTS = ("observation", "policy_mean")
OUTPUT, SHIELD = "action", "shield"
LARGEST_DIFFERENCE = 1e-5

_templates: dict[tuple[object, ...], onnx.ModelProto] = {}
_tracing = threading.Lock()
"""torch traces one module at a time; a filter that is due waits for a trace that was begun beforehand."""


class ExportDiffers(RuntimeError):
    """The exported filter does not compute what the trained one does; nothing was published."""


def to_onnx(module: AnyFilter, observations: Float32Array, policy_means: Float32Array) -> bytes:
    """Export with a free batch size, then compare with torch on these inputs, (N, D) and (N, 7).

    Tracing takes seconds, so it is done once per structure and process; after that the numbers are put into the traced
    graph. The comparison would notice a graph in which some number had been built in.
    Raises ExportDiffers when any action differs by more than 1e-5.
    """
    state = {name: tensor.detach().numpy() for name, tensor in module.state_dict().items()}
    shapes = tuple((name, array.shape) for name, array in sorted(state.items()))
    structure = (module.structure, shapes)
    with _tracing:
        if structure not in _templates:
            _templates[structure] = _template(_trace(module, observations[:2], policy_means[:2]), list(state))
    model = onnx.ModelProto()
    model.CopyFrom(_templates[structure])
    used = {name for node in model.graph.node for name in node.input}  # not all, where a filter changes nothing
    model.graph.initializer.extend(onnx.numpy_helper.from_array(state[name], name) for name in sorted(used & {*state}))
    stored: bytes = model.SerializeToString(deterministic=True)
    difference = largest_difference(stored, module, observations, policy_means)
    if not difference <= LARGEST_DIFFERENCE:
        raise ExportDiffers(f"{ExportDiffers.__doc__} The largest difference is {difference:.1e}.")
    return stored


def largest_difference(
    stored: bytes, module: AnyFilter, observations: Float32Array, policy_means: Float32Array
) -> float:
    """Between the exported and the torch filter, over these inputs."""
    with torch.no_grad():
        said = module(torch.from_numpy(observations), torch.from_numpy(policy_means))
    expected = said if isinstance(said, tuple) else (said,)
    exported = OnnxFilter(stored).run(observations, policy_means)
    pairs = zip(exported, expected, strict=True)
    return max(float(np.abs(each - wanted.numpy()).max()) for each, wanted in pairs)


class OnnxFilter:
    """A rollout's callable made from the bytes of filter.onnx. Can be sent to another process."""

    def __init__(self, stored: bytes) -> None:
        self.stored = stored
        self._session = _session(stored)

    def __call__(self, observation: Float32Array, policy_mean: Float32Array) -> Float32Array:
        """(D,), (7,) -> (7,)"""
        action: Float32Array = self.batch(observation[None], policy_mean[None])[0]
        return action

    def batch(self, observations: Float32Array, policy_means: Float32Array) -> Float32Array:
        """(B, D), (B, 7) -> (B, 7)"""
        return self.run(observations, policy_means, [OUTPUT])[0]

    def run(
        self, observations: Float32Array, policy_means: Float32Array, names: Sequence[str] | None = None
    ) -> list[Float32Array]:
        """(B, D), (B, 7) -> these outputs, or all there are: the actions (B, 7) and a shield's activity (B, 1)."""
        feed = dict(zip(INPUTS, (_float32(observations), _float32(policy_means)), strict=True))
        outputs: list[Float32Array] = self._session.run(names, feed)
        return outputs

    @property
    def is_shielded(self) -> bool:
        """Whether the file says what its shield does. Those of earlier versions have none."""
        return SHIELD in [each.name for each in self._session.get_outputs()]

    @property
    def opset(self) -> int:
        """Version of the ONNX operator set the file uses."""
        opsets = onnx.load_from_string(self.stored).opset_import
        return max(int(each.version) for each in opsets if each.domain == "")

    def __reduce__(self) -> tuple[Any, ...]:
        return OnnxFilter, (self.stored,)


def _float32(array: npt.ArrayLike) -> Float32Array:
    return np.ascontiguousarray(array, np.float32)


@lru_cache(maxsize=4)
def _session(stored: bytes) -> Any:
    """The last few are kept: an export is compared first and used then, and processes get one filter many times."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(stored, options, providers=["CPUExecutionProvider"])


def _trace(module: AnyFilter, observations: Float32Array, policy_means: Float32Array) -> onnx.ModelProto:
    """The graph, with every parameter and buffer as an initializer of the same name."""
    example = (torch.from_numpy(observations.copy()), torch.from_numpy(policy_means.copy()))
    batch = torch.export.Dim("batch", min=1)
    with _Quiet():
        program = torch.onnx.export(
            module,
            example,
            dynamo=True,
            optimize=False,
            input_names=list(INPUTS),
            output_names=list(module.outputs),
            dynamic_shapes=({0: batch}, {0: batch}),
            verbose=False,
        )
    if program is None:  # the signature allows it for the old, TorchScript-based exporter only
        raise ExportDiffers
    traced: onnx.ModelProto = program.model_proto
    return traced


def _template(model: onnx.ModelProto, weights: Sequence[str]) -> onnx.ModelProto:
    """The graph without its weights and with a third of the nodes, which halves the time per call.

    While the optimiser works the weights are inputs: what it computes beforehand then holds for any of them.
    """
    initializers = {each.name: each for each in model.graph.initializer}
    variable = [initializers[name] for name in weights if name in initializers]
    for each in variable:
        model.graph.initializer.remove(each)
        model.graph.input.append(onnx.helper.make_tensor_value_info(each.name, each.data_type, each.dims))
    with _Quiet():
        smaller = _without_notes(onnxscript.optimizer.optimize(model))
    for each in [each for each in smaller.graph.input if each.name not in INPUTS]:
        smaller.graph.input.remove(each)
    return smaller


def _without_notes(model: onnx.ModelProto) -> onnx.ModelProto:
    """The same without what tracing notes: modules and lines of code, with the folders of whoever exports."""
    noted = ClearMetadataAndDocStringPass()(onnx_ir.from_proto(model)).model
    noted.producer_version = torch.__version__.partition("+")[0]
    return onnx_ir.to_proto(noted)


class _Quiet:
    """Hold back what exporter and optimiser say about their own internals; there is nothing here to do better."""

    def __init__(self) -> None:
        self._loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
        self._levels = [logger.level for logger in self._loggers]
        self._warnings = warnings.catch_warnings()

    def __enter__(self) -> None:
        self._warnings.__enter__()
        warnings.simplefilter("ignore")
        for logger in self._loggers:
            logger.setLevel(logging.ERROR)

    def __exit__(self, *exception: object) -> None:
        for logger, level in zip(self._loggers, self._levels, strict=True):
            logger.setLevel(level)
        self._warnings.__exit__(*exception)  # type: ignore[arg-type]
