"""Small fully connected networks as plain arrays: what is stored and shipped is read and run without torch."""

from collections.abc import Mapping, Sequence

import numpy as np

from worker.domain.type_aliases import Float32Array

Layers = tuple[tuple[Float32Array, Float32Array], ...]
"""Per layer a matrix (..., in, out) and a bias (..., 1, out); leading axes are members of an ensemble."""


def run(layers: Layers, inputs: Float32Array) -> Float32Array:
    """(..., N, in) -> (..., N, out); SiLU between the layers, nothing after the last."""
    hidden = inputs
    for matrix, bias in layers[:-1]:
        hidden = hidden @ matrix + bias
        hidden = np.asarray(hidden / (1.0 + np.exp(-np.clip(hidden, -60.0, 60.0))))
    matrix, bias = layers[-1]
    return np.asarray(hidden @ matrix + bias)


def named(layers: Layers) -> dict[str, Float32Array]:
    """The arrays by name, as files have them."""
    found = {}
    for index, (matrix, bias) in enumerate(layers):
        found[f"matrix_{index}"], found[f"bias_{index}"] = matrix, bias
    return found


def of_named(tensors: Mapping[str, Float32Array]) -> Layers:
    """What named() took apart; other names are left alone."""
    count = sum(name.startswith("matrix_") for name in tensors)
    return tuple((tensors[f"matrix_{index}"], tensors[f"bias_{index}"]) for index in range(count))


def of_parameters(parameters: Sequence[Float32Array]) -> Layers:
    """From matrix, bias, matrix, bias, ..."""
    return tuple(zip(parameters[::2], parameters[1::2], strict=True))
