"""Numbers in an array of objects, as NumPy pickles it, read without running anything of it.

A pickle is a program that may call whatever it names. Here every name stands for a class of ours that only remembers,
so that nothing of NumPy is called with what a stranger has written; any other name is refused.
"""

import codecs
import io
import pickle
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.lib import format as npy

from worker.domain.type_aliases import FloatArray

MOST_VALUES = 1 << 20
"""Of one array in it."""


class PickleRefused(ValueError):
    """This holds something else than plain numbers."""


class _Type:
    """Stands for numpy.dtype: numbers of fixed size, little-endian or of one byte, or objects."""

    def __init__(self, code: str = "", *_: object) -> None:
        self._code, self._order = str(code), "<"

    def __setstate__(self, state: Sequence[Any]) -> None:
        self._order = str(state[1])

    @property
    def is_object(self) -> bool:
        return self._code == "O8"

    def read(self, content: object) -> FloatArray:
        """(N,) the numbers."""
        sizes = {"f": (2, 4, 8), "i": (1, 2, 4, 8), "u": (1, 2, 4, 8), "b": (1,)}
        kind, size = self._code[:1], self._code[1:]
        if not size.isdigit() or int(size) not in sizes.get(kind, ()) or self._order not in "<|=":
            raise PickleRefused(f"an array of type {self._code[:20]!r}")
        if not isinstance(content, bytes) or len(content) > MOST_VALUES * 8 or len(content) % int(size):
            raise PickleRefused("an array of another size than it says")
        return np.frombuffer(content, f"<{kind}{size}").astype(np.float64)


class _Array:
    """Stands for numpy.ndarray: its numbers, flat, or its objects."""

    def __init__(self) -> None:
        self.values: FloatArray | list[Any] = []

    def __setstate__(self, state: Sequence[Any]) -> None:
        _, _, kind, _, content = state
        if not isinstance(kind, _Type):
            raise PickleRefused("an array without a type")
        self.values = list(content) if kind.is_object else kind.read(content)


def _array(*_: object) -> _Array:
    return _Array()


def _from_buffer(content: object, kind: object, *_: object) -> _Array:
    if not isinstance(kind, _Type):
        raise PickleRefused("an array without a type")
    found = _Array()
    found.values = kind.read(bytes(content) if isinstance(content, bytearray) else content)
    return found


def _scalar(kind: object, content: object = b"") -> float:
    if not isinstance(kind, _Type):
        raise PickleRefused("a number without a type")
    return float(kind.read(content)[0])


def _bytes(text: str, encoding: str) -> bytes:
    if encoding != "latin1":
        raise PickleRefused(f"bytes as {encoding[:20]}")
    return codecs.encode(text, "latin1")


_KNOWN: dict[str, Callable[..., Any]] = {
    "multiarray._reconstruct": _array,
    "multiarray.scalar": _scalar,
    "numeric._frombuffer": _from_buffer,
    "numpy.ndarray": _Array,
    "numpy.dtype": _Type,
    "_codecs.encode": _bytes,
}
"""By the last two parts of their names: NumPy 2 moved them."""


class _Reader(pickle._Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """One of ours. Raises PickleRefused."""
        known = _KNOWN.get(f"{module.rpartition('.')[2]}.{name}")
        if known is None or module.partition(".")[0] not in ("numpy", "_codecs"):
            raise PickleRefused(f"it wants to call {module[:60]}.{name[:60]}, which is refused")
        return known

    def persistent_load(self, pid: object) -> Any:
        """There is none."""
        raise PickleRefused("it refers to something outside")


def rows(content: bytes) -> list[dict[str, FloatArray]]:
    """A .npy file that holds an array of dictionaries of numbers: one by row, arrays flat. Raises PickleRefused."""
    file = io.BytesIO(content)
    try:
        version = npy.read_magic(file)
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        header(file)
        found = _Reader(file).load()
    except PickleRefused:
        raise
    except Exception as error:  # whatever a program of a stranger's makes our reader stumble over
        raise PickleRefused(f"damaged ({type(error).__name__})") from error
    if not isinstance(found, _Array) or not all(isinstance(each, dict) for each in found.values):
        raise PickleRefused("something else than an array of dictionaries")
    return [_numbers(row) for row in found.values]


def _numbers(row: Mapping[object, object]) -> dict[str, FloatArray]:
    return {str(name): flat for name, each in row.items() if (flat := _flat(each)) is not None}


def _flat(value: object) -> FloatArray | None:
    """(N,) of a number, a list of numbers, or an array; None for anything else."""
    if isinstance(value, _Array):
        value = value.values
    if isinstance(value, np.ndarray):
        return value
    if isinstance(value, bool | int | float):
        value = [value]
    if isinstance(value, list | tuple) and len(value) <= MOST_VALUES:
        numbers = [each.values[0] if isinstance(each, _Array) and len(each.values) == 1 else each for each in value]
        if all(isinstance(each, bool | int | float) for each in numbers):
            return np.array(numbers, np.float64)
    return None
