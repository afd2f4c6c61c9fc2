"""Options of the command line and the fields that they fill."""

import argparse
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

import pytest

from app.domain.protocol import EvaluationSettings
from app.domain.study_settings import StudySettings
from worker import cli, stop_signals
from worker.__main__ import main
from worker.commands import benchmarking, options, rehearsing
from worker.experiments.benchmark import PROFILES
from worker.ml.teachers import Manner


class Colour(StrEnum):
    """An enumeration."""

    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True)
class Inner:
    """A part."""

    steps: int = 7


@dataclass(frozen=True)
class Config:
    """Every kind of field that an option fills."""

    count: int = 3
    size: float | None = None
    rule: Literal["first", "last"] = "last"
    colour: Colour = Colour.BLUE
    stops: tuple[int, ...] = (1, 2)
    loud: bool = False
    inner: Inner = field(default_factory=Inner)


TABLE: options.Table = {
    "count": ("--count", "how many"),
    "size": ("--size", "in metres"),
    "rule": ("--rule", ""),
    "colour": ("--colour", ""),
    "stops": ("--stops", ""),
    "loud": ("--loud", ""),
    "inner.steps": ("--inner-steps", ""),
}


def parse(*words: str, only_said: bool = False) -> argparse.Namespace:
    command = argparse.ArgumentParser()
    options.add(command, TABLE, Config(), only_said=only_said)
    return command.parse_args(words)


def test_without_a_word_everything_is_as_the_configuration_has_it() -> None:
    assert options.filled(Config(), TABLE, parse()) == Config()


def test_what_is_said_has_the_type_of_its_field() -> None:
    words = [
        "--count",
        "4",
        "--size",
        "1.5",
        "--rule",
        "first",
        "--colour",
        "red",
        "--stops",
        "5",
        "6",
        "7",
        "--loud",
        "--inner-steps",
        "9",
    ]
    wanted = Config(4, 1.5, "first", Colour.RED, (5, 6, 7), True, Inner(9))
    assert options.filled(Config(), TABLE, parse(*words)) == wanted
    assert options.filled(Config(), TABLE, parse("--stops")).stops == ()


def test_a_command_that_chooses_its_defaults_later_gets_what_was_said_alone() -> None:
    other = Config(count=100, inner=Inner(200))
    said = parse("--count", "5", only_said=True)
    assert options.filled(other, TABLE, said) == Config(count=5, inner=Inner(200))


@pytest.mark.parametrize("wrong", [["--count", "x"], ["--rule", "third"], ["--colour", "green"], ["--stops", "one"]])
def test_what_no_field_can_hold_is_refused(wrong: list[str]) -> None:
    with pytest.raises(SystemExit) as end:
        parse(*wrong)
    assert end.value.code == 2


def test_the_help_names_the_default_that_holds(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parse("--help")
    text = " ".join(capsys.readouterr().out.split())
    assert "--count COUNT how many; default: 3" in text
    assert "--stops [STOPS ...] default: 1 2" in text
    assert "--size SIZE in metres --" in text


@pytest.mark.parametrize(
    ("command", "table", "config"),
    [
        ("rehearse", rehearsing.OF_EVALUATION, EvaluationSettings()),
        ("rehearse", rehearsing.OF_MANNER, Manner(skip_share=0.02)),
        ("benchmark", benchmarking.OF_TERMS, None),
    ],
)
def test_a_command_without_options_uses_the_usual_values(command: str, table: options.Table, config: Any) -> None:
    said = vars(cli.parser().parse_args([command]))
    assert {path: said[path] for path in table} == {path: config and getattr(config, path) for path in table}


def _commands() -> "argparse._SubParsersAction[argparse.ArgumentParser]":
    (commands,) = (each for each in cli.parser()._actions if isinstance(each, argparse._SubParsersAction))
    return commands


def test_commands_say_what_they_do_without_words_for_programmers() -> None:
    commands = _commands()
    listed = {each.dest: each.help or "" for each in commands._choices_actions}
    assert list(listed) == list(cli.MODULES)
    for name, summary in listed.items():
        assert summary.endswith("."), name
        assert not any(word in summary for word in ("``", "Raises ", "returns ")), name
        assert commands.choices[name].description, f"{name} --help does not say what it does"


def test_no_option_has_two_defaults() -> None:
    told = [action.help or "" for command in _commands().choices.values() for action in command._actions]
    assert len(told) > 50
    assert [each for each in told if each.count("default:") > 1] == []


@pytest.mark.parametrize(
    ("said", "labels", "milestones"),
    [
        ([], StudySettings().labels_per_participant, StudySettings().milestones),
        (["--paper"], 200, (50, 100, 200)),
        (["--paper", "--labels", "60", "--milestones", "30"], 60, (30, 60)),
    ],
)
def test_a_rehearsal_asks_as_much_as_the_study_that_it_rehearses(
    said: list[str], labels: int, milestones: tuple[int, ...]
) -> None:
    settings = rehearsing.settings_of(cli.parser().parse_args(["rehearse", *said]))
    assert (settings.labels_per_participant, settings.milestones) == (labels, milestones)
    assert settings.pool_scenarios * settings.pairs_per_scenario >= labels


def test_a_benchmark_fills_parts_of_its_configuration() -> None:
    said = cli.parser().parse_args(
        ["benchmark", "--prefft-steps", "5", "--pbrl-steps", "6", "--printed-steps", "7", "--mistakes", "0.5"]
    )
    terms = options.filled(PROFILES["full"], benchmarking.OF_TERMS, said)
    methods = terms.methods
    assert (methods.fine_tuning.steps, methods.from_scratch.steps, methods.printed_steps) == (5, 6, 7)
    assert (terms.manner.mistakes, terms.labels) == (0.5, PROFILES["full"].labels)


@pytest.mark.parametrize("option", ["--mistakes", "--equal", "--skip"])
def test_no_share_is_more_than_everything(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.parser().parse_args(["rehearse", option, "1.5"])
    assert "from 0 to 1" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("said", "name"),
    [(["--labels", "0"], "labels_per_participant"), (["--paper", "--fine-tuning-steps", "0"], "fine_tuning_steps")],
)
def test_settings_that_no_study_can_have_are_refused_in_words_before_anything_starts(
    said: list[str], name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rehearsing, "OwnStudio", None)  # a server that was started would fail otherwise
    monkeypatch.setattr(stop_signals, "any_signal_is_ctrl_c", lambda: None)  # the suite keeps its own
    assert main(["rehearse", *said]) == 1
    told = capsys.readouterr().err
    assert "cannot have these settings" in told
    assert name in told


def test_so_are_those_of_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rehearsing, "OwnStudio", None)
    monkeypatch.setattr(stop_signals, "any_signal_is_ctrl_c", lambda: None)
    file = tmp_path / "study.json"
    for written, told in (("{", "Invalid JSON"), ('{"labels_per_participant": 0}', "labels_per_participant")):
        file.write_text(written)
        assert main(["rehearse", "--settings", str(file)]) == 1
        assert told in capsys.readouterr().err
