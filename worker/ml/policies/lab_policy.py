"""Policies that laboratories bring: ONNX, Stable-Baselines3's zip files by their weights alone, and our own files."""

import io
import json
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError

from worker.domain.type_aliases import Float32Array, FloatArray
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.policies.onnx_policy import NotAPolicy, OnnxPolicy, adapted, mlp_to_onnx, said_by_file
from worker.ml.policies.policy_onnx import policy_to_onnx

LARGEST_BYTES = 256 << 20
NOT_PLAIN = "its layer {} is not a plain one (pictures, normalisation); export it as ONNX."
_WEIGHTS, _DATA = "policy.pth", "data"
_OPERATIONS = {"relu": "Relu", "tanh": "Tanh", "elu": "Elu"}


def load(
    file: Path,
    own_size: int,
    observation_size: int,
    bounds: tuple[FloatArray, FloatArray],
    gain: float | FloatArray = 1.0,
    activation: str | None = None,
    settings: Mapping[int, float] = MappingProxyType({}),
) -> OnnxPolicy:
    """The policy in a file; for sizes, bounds and settings see onnx_policy.adapted(). Nothing is unpickled.

    Raises NotAPolicy.
    """
    if file.stat().st_size > LARGEST_BYTES:
        raise NotAPolicy(f"{file.name} is larger than {LARGEST_BYTES >> 20} MB.")
    try:
        if file.suffix == ".onnx":
            stored = file.read_bytes()
        elif file.suffix == ".zip":
            stored = _of_stable_baselines(file, activation, bounds, settings)
        else:
            stored = _of_ours(file, bounds)
        return adapted(stored, own_size, observation_size, bounds, gain, settings)
    except NotAPolicy as error:
        raise NotAPolicy(f"{file.name}: {error}") from error


def _of_ours(file: Path, bounds: tuple[FloatArray, FloatArray]) -> bytes:
    try:
        policy = GaussianPolicy.load(file)
    except (SafetensorError, KeyError) as error:
        raise NotAPolicy(
            f"it is not a policy.safetensors of the studio ({error}). It needs offset, scale, and weight_i and bias_i "
            "of three layers; export any other network as ONNX."
        ) from error
    if not (np.allclose(bounds[0], -1.0) and np.allclose(bounds[1], 1.0)):
        raise NotAPolicy(
            "it says actions in [-1, 1], and the environment has other bounds; wrap it with RescaleAction."
        )
    return policy_to_onnx(policy)


def _of_stable_baselines(
    file: Path, activation: str | None, bounds: tuple[FloatArray, FloatArray], settings: Mapping[int, float]
) -> bytes:
    """The actor of SAC, TQC, TD3, DDPG, PPO, TRPO or A2C, told by the names of its weights."""
    state = _state(file)
    if any("lstm" in name for name in state):
        raise NotAPolicy(
            "it is recurrent, and the studio asks for a function of what is seen. Train one without memory, or let the "
            "environment's observation hold what it has to remember (gymnasium.wrappers.FrameStackObservation and "
            "FlattenObservation)."
        )
    arguments = _arguments(file)
    activation = activation or _told_activation(arguments)
    if any(name.startswith("actor.latent_pi") for name in state) and "actor.mu.weight" not in state:
        raise NotAPolicy("its noise depends on the state (use_sde=True), whose mean is bounded; export it as ONNX.")
    found: list[tuple[Float32Array, Float32Array]]
    if "actor.mu.weight" in state:  # SAC: hidden layers, then a mean and a tanh
        found, squash, usual = [*_layers(state, "actor.latent_pi"), _layer(state, "actor.mu")], "Tanh", "relu"
    elif any(name.startswith("actor.mu.") for name in state):  # TD3 and DDPG
        found, squash, usual = _layers(state, "actor.mu"), "Tanh", "relu"
    elif "action_net.weight" in state:  # PPO and A2C: a mean in the environment's own unit, clipped
        if arguments.get("squash_output"):
            raise NotAPolicy("its actions are squashed (squash_output=True); export it as ONNX.")
        found, squash, usual = [*_layers(state, "mlp_extractor.policy_net"), _layer(state, "action_net")], "", "tanh"
    else:
        raise NotAPolicy(
            f"its weights ({', '.join(sorted(state)[:4])}, ...) are none of SAC, TQC, TD3, DDPG, "
            "PPO, TRPO or A2C; export it as ONNX."
        )
    if any("features_extractor" in name and "mlp" not in name for name in state):
        raise NotAPolicy("it looks at pictures or has features of its own; export it as ONNX.")
    stored = mlp_to_onnx(found, _OPERATIONS[activation or usual], squash)
    if not squash:
        return stored
    own = said_by_file(len(found[-1][1]), len(bounds[0]), settings)
    return _stretched(stored, (bounds[0][own], bounds[1][own]))


def _stretched(stored: bytes, bounds: tuple[FloatArray, FloatArray]) -> bytes:
    """A network that says actions in [-1, 1] as one that says them in the environment's unit."""
    low, high = bounds
    if np.allclose(low, -1.0) and np.allclose(high, 1.0):
        return stored
    import onnx
    from onnx import helper, numpy_helper

    model = onnx.load_from_string(stored)
    model.graph.initializer.extend(
        [
            numpy_helper.from_array(((high - low) / 2.0).astype(np.float32), "half"),
            numpy_helper.from_array(((high + low) / 2.0).astype(np.float32), "middle"),
        ]
    )
    model.graph.node[-1].output[0] = "squashed"
    model.graph.node.extend(
        [
            helper.make_node("Mul", ["squashed", "half"], ["scaled"]),
            helper.make_node("Add", ["scaled", "middle"], ["action"]),
        ]
    )
    written: bytes = model.SerializeToString(deterministic=True)
    return written


def _state(file: Path) -> Mapping[str, Any]:
    """The weights alone: what else is in such a file is pickled, and would run whatever it says."""
    try:
        with zipfile.ZipFile(file) as archive:
            if archive.getinfo(_WEIGHTS).file_size > LARGEST_BYTES:
                raise NotAPolicy(f"its {_WEIGHTS} would unpack to more than {LARGEST_BYTES >> 20} MB.")
            stored = archive.read(_WEIGHTS)
    except (zipfile.BadZipFile, KeyError) as error:
        raise NotAPolicy(f"it is not what model.save() of Stable-Baselines3 writes: it has no {_WEIGHTS}.") from error
    try:
        state = torch.load(io.BytesIO(stored), map_location="cpu", weights_only=True)
    except Exception as error:  # pickle raises many kinds
        raise NotAPolicy(
            f"its {_WEIGHTS} holds more than weights and would have to be unpickled, which runs whatever is in it. "
            "Save the model again with Stable-Baselines3 2, or export it as ONNX."
        ) from error
    if not isinstance(state, Mapping):
        raise NotAPolicy(f"its {_WEIGHTS} holds no weights by name.")
    return state


def _arguments(file: Path) -> Mapping[str, Any]:
    """What the file's readable part says of how its networks were made; empty: nothing."""
    with zipfile.ZipFile(file) as archive:
        if _DATA not in archive.namelist() or archive.getinfo(_DATA).file_size > LARGEST_BYTES:
            return {}
        try:
            data = json.loads(archive.read(_DATA))
        except ValueError:
            return {}
    arguments = data.get("policy_kwargs") if isinstance(data, dict) else None
    return arguments if isinstance(arguments, dict) else {}


def _told_activation(arguments: Mapping[str, Any]) -> str | None:
    """The activation function's name; None: the file says none, so it is its algorithm's usual one.

    What is stored of a class is its name beside its pickle; the name alone is read. Raises NotAPolicy for a function
    that is not known here.
    """
    said = str(arguments.get("activation_fn", ""))
    if not (named := re.search(r"activation\.(\w+)'", said)):
        return None
    if named[1].lower() not in _OPERATIONS:
        raise NotAPolicy(
            f"its activation function is {named[1]}; only ReLU, Tanh and ELU are known. Export it as ONNX."
        )
    return named[1].lower()


def _layers(state: Mapping[str, Any], prefix: str) -> list[tuple[Float32Array, Float32Array]]:
    inside = [name for name in state if name.startswith(f"{prefix}.")]
    for name in inside:
        if not re.fullmatch(rf"{re.escape(prefix)}\.\d+\.(weight|bias)", name):
            raise NotAPolicy(NOT_PLAIN.format(name))
    numbers = sorted({int(name.split(".")[-2]) for name in inside})
    return [_layer(state, f"{prefix}.{number}") for number in numbers]


def _layer(state: Mapping[str, Any], name: str) -> tuple[Float32Array, Float32Array]:
    weight, bias = state[f"{name}.weight"], state.get(f"{name}.bias")
    if weight.ndim != 2:
        raise NotAPolicy(NOT_PLAIN.format(name))
    shift = np.zeros(len(weight), np.float32) if bias is None else bias.numpy().astype(np.float32)
    return weight.numpy().astype(np.float32), shift
