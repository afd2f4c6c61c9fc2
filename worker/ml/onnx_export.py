"""The filter as an ONNX file, checked against torch, and as a fast callable for rollouts."""

import logging
import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime
import torch

from worker.ml.action_filter import ActionFilter

Array = npt.NDArray[np.float32]

INPUTS = ("observation", "policy_mean")
OUTPUT = "action"
LARGEST_DIFFERENCE = 1e-5


class ExportDiffers(RuntimeError):
    """The exported filter does not compute what the trained one does; nothing was published."""


def to_onnx(module: ActionFilter, observations: Array, policy_means: Array) -> bytes:
    """Export with a free batch size, then compare with torch on these inputs, (N, D) and (N, 7).

    Raises ExportDiffers when any action differs by more than 1e-5.
    """
    example = (torch.from_numpy(observations[:2].copy()), torch.from_numpy(policy_means[:2].copy()))
    batch = torch.export.Dim("batch", min=1)
    with warnings.catch_warnings(), _Quiet("torch.onnx", "onnxscript", "onnx_ir"):
        # The exporter warns about its own internals; there is nothing here that we could do better.
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            module,
            example,
            dynamo=True,
            input_names=list(INPUTS),
            output_names=[OUTPUT],
            dynamic_shapes=({0: batch}, {0: batch}),
            verbose=False,
        )
    stored = _serialised(program)
    difference = largest_difference(stored, module, observations, policy_means)
    if not difference <= LARGEST_DIFFERENCE:
        raise ExportDiffers(f"{ExportDiffers.__doc__} The largest difference is {difference:.1e}.")
    return stored


def largest_difference(stored: bytes, module: ActionFilter, observations: Array, policy_means: Array) -> float:
    """Between the exported and the torch filter, over these inputs."""
    with torch.no_grad():
        expected = module(torch.from_numpy(observations), torch.from_numpy(policy_means)).numpy()
    return float(np.abs(OnnxFilter(stored).batch(observations, policy_means) - expected).max())


class OnnxFilter:
    """A rollout's callable made from the bytes of filter.onnx. Can be sent to another process."""

    def __init__(self, stored: bytes) -> None:
        self.stored = stored
        self._session = _session(stored)

    def __call__(self, observation: Array, policy_mean: Array) -> Array:
        """(D,), (7,) -> (7,)"""
        action: Array = self.batch(observation[None], policy_mean[None])[0]
        return action

    def batch(self, observations: Array, policy_means: Array) -> Array:
        """(B, D), (B, 7) -> (B, 7)"""
        feed = dict(zip(INPUTS, (_float32(observations), _float32(policy_means)), strict=True))
        actions: Array = self._session.run([OUTPUT], feed)[0]
        return actions

    @property
    def opset(self) -> int:
        """Version of the ONNX operator set the file uses."""
        opsets = onnx.load_from_string(self.stored).opset_import
        return max(int(each.version) for each in opsets if each.domain == "")

    def __reduce__(self) -> tuple[Any, ...]:
        return OnnxFilter, (self.stored,)


def _float32(array: npt.ArrayLike) -> Array:
    return np.ascontiguousarray(array, np.float32)


def _session(stored: bytes) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(stored, options, providers=["CPUExecutionProvider"])


def _serialised(program: "torch.onnx.ONNXProgram | None") -> bytes:
    if program is None:  # the exporter's signature allows it for the old, TorchScript-based path only
        raise ExportDiffers
    stored: bytes = program.model_proto.SerializeToString(deterministic=True)
    return stored


class _Quiet:
    """Hold back log records below ERROR of these loggers."""

    def __init__(self, *names: str) -> None:
        self._loggers = [logging.getLogger(name) for name in names]
        self._levels = [logger.level for logger in self._loggers]

    def __enter__(self) -> None:
        for logger in self._loggers:
            logger.setLevel(logging.ERROR)

    def __exit__(self, *exception: object) -> None:
        for logger, level in zip(self._loggers, self._levels, strict=True):
            logger.setLevel(level)
