"""Options of the command line that fill fields of a configuration: type, choices and default are those of the field.

A table says which option fills which field, and in which words: {"methods.printed_steps": ("--printed-steps", "...")}.
"""

import argparse
from collections.abc import Mapping
from dataclasses import replace
from enum import Enum
from math import isfinite
from types import NoneType
from typing import Any, Literal, TypeAlias, TypeVar, get_args, get_origin, get_type_hints

from worker.ml.teachers import TASTES, LabTaste, Taste

Table: TypeAlias = Mapping[str, tuple[str, str]]
"""The path of a field -> the option and its help."""
_Config = TypeVar("_Config")


def add(command: argparse.ArgumentParser, table: Table, config: object, *, only_said: bool = False) -> None:
    """Add options that fill a dataclass or a model of settings; ``config`` has the defaults.

    ``only_said``: what was not said is None, for a command that chooses its defaults later; the help names those here,
    unless its words name another.
    """
    for path, (option, words) in table.items():
        *outer, name = path.split(".")
        owner = config
        for each in outer:
            owner = getattr(owner, each)
        default = getattr(owner, name)
        how = _how(name, get_type_hints(type(owner))[name])
        if "action" not in how:
            how["default"] = None if only_said else default
            if "default:" not in words:
                words = "; ".join(part for part in (words, _default_in_words(default)) if part)
            how |= {} if "choices" in how else {"metavar": option.strip("-").upper().replace("-", "_")}
        command.add_argument(option, dest=path, help=words, **how)


def filled(config: _Config, table: Table, options: argparse.Namespace) -> _Config:
    """A dataclass with what was said on the command line; None leaves a field as it is."""
    for path in table:
        value = getattr(options, path)
        if value is not None:
            config = _replaced(config, path.split("."), tuple(value) if isinstance(value, list) else value)
    return config


def _replaced(config: Any, names: list[str], value: object) -> Any:
    first, *inner = names
    return replace(config, **{first: _replaced(getattr(config, first), inner, value) if inner else value})


def _how(name: str, kind: Any) -> dict[str, Any]:
    """What argparse has to know about a field of this name and type."""
    kinds = [each for each in get_args(kind) if each not in (NoneType, Ellipsis)]
    if name in _CHECKED:
        return {"type": _CHECKED[name]}
    if kind is bool:
        return {"action": "store_true"}
    if get_origin(kind) is Literal:
        return {"choices": kinds}
    if get_origin(kind) is tuple:
        return {"type": kinds[0], "nargs": "*"}
    plain = kinds[0] if kinds else kind
    return {"type": plain, "choices": list(plain)} if issubclass(plain, Enum) else {"type": plain}


def _default_in_words(default: object) -> str:
    if default is None:
        return ""
    return "default: " + (" ".join(str(each) for each in default) if isinstance(default, tuple) else str(default))


def share(text: str) -> float:
    """A number from 0 to 1."""
    value = float(text)
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"{text} is no share; give a number from 0 to 1.")
    return value


def positive(text: str) -> float:
    """A finite number above 0."""
    value = float(text)
    if not (value > 0.0 and isfinite(value)):
        raise argparse.ArgumentTypeError(f"{text} must be a number above 0.")
    return value


def taste(text: str) -> Taste:
    """A known user, or somebody with weights of their own: six for omega, then signal:weight as often as wanted.

    Of a laboratory's task there is no omega, so signals alone: quick=distance_m:1,height_m:-2.
    """
    name, _, weights = text.partition("=")
    if not weights and name in TASTES:
        return TASTES[name]
    omega = [part for part in weights.split(",") if ":" not in part]
    signals = [part.split(":", 1) for part in weights.split(",") if ":" in part]
    try:
        if not name.replace("-", "").isalnum() or (name in TASTES and omega):
            raise ValueError(f"A user of one's own needs a new name of letters, digits and hyphens; got {name!r}.")
        per_signal = {signal: float(weight) for signal, weight in signals}
        if signals and not omega:
            return LabTaste(name, per_signal=per_signal)
        return Taste(name, tuple(float(weight) for weight in omega), per_signal)
    except ValueError as error:
        known = ", ".join(TASTES)
        raise argparse.ArgumentTypeError(f"{text!r} is none of {known}, nor NAME=six,weights,...: {error}") from error


_CHECKED = {"mistakes": share, "equal_share": share, "skip_share": share, "rationality": positive}
"""Fields with bounds that their type does not tell."""
