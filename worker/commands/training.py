"""What a task needs once for everybody: a reference policy, a response surface, foresight."""

import argparse
import json
import sys
from pathlib import Path

from app.commands.parsers import Commands, add_command
from app.settings import Settings
from worker.commands.arguments import add_processes, add_task
from worker.experiments import (
    archive_modes,
    archive_policies,
    archive_policies_in_modes,
    fit_response_surface,
    pretrain_policy,
    train_signal_predictor,
)
from worker.ml.policies.onnx_policy import NotAPolicy
from worker.sim.lab.errors import LabTaskBroken
from worker.tasks.registry import NotExplored, checkpoint


def add(commands: Commands) -> None:
    """Add what is trained and driven once for everybody, from ``pretrain`` to ``foresee``."""
    pretrain = add_command(commands, "pretrain", _pretrain)
    add_task(pretrain)
    pretrain.add_argument("--seed", type=int, default=0)
    pretrain.add_argument("--directory", type=Path, help="where the policy goes; default: where the studio keeps it")

    explore = add_command(commands, "explore", _explore)
    add_task(explore)
    explore.add_argument("--work-directory", type=Path, help="finished blocks; default: explore/ in the data directory")
    explore.add_argument("--scenarios", type=int, default=fit_response_surface.SCENARIOS, help="each in twelve modes")
    explore.add_argument("--sought", type=int, help="scenarios of every later round; default: a fifth of the first's")
    add_processes(explore)

    archive = add_command(commands, "archive", _archive)
    add_task(archive)
    archive.add_argument("--work-directory", type=Path, help="finished blocks; default: archive/ in the data directory")
    add_processes(archive)

    policies = add_command(commands, "archive-policies", _archive_policies)
    add_task(policies)
    policies.add_argument(
        "--work-directory", type=Path, help="finished policies; default: archive-policies/ in the data directory"
    )

    in_modes = add_command(commands, "archive-policies-in-modes", _archive_policies_in_modes)
    add_task(in_modes)
    in_modes.add_argument(
        "--work-directory", type=Path, help="what was driven; default: archive-policies-in-modes/ in the data directory"
    )

    foresee = add_command(commands, "foresee", _foresee)
    add_task(foresee)
    foresee.add_argument("--work-directory", type=Path, help="rollouts; default: foresight/ in the data directory")
    foresee.add_argument(
        "--scenarios", type=int, default=train_signal_predictor.SCENARIOS, help="each in six behaviours"
    )
    add_processes(foresee)


def _pretrain(said: argparse.Namespace) -> int:
    """Train a task's reference policy by SAC, or go on with a training that was interrupted (ten to twenty minutes)."""
    return pretrain_policy.pretrain(said.task, said.seed, said.directory or checkpoint(said.task))


def _explore(said: argparse.Namespace) -> int:
    """Drive a task in many modes and fit its response surface, from which filters are found; finished work is kept."""
    work = said.work_directory or Settings().data_dir / "explore" / said.task
    try:
        record = fit_response_surface.explore(said.task, work, said.processes, said.scenarios, said.sought)
    except (LabTaskBroken, NotAPolicy, fit_response_surface.NoRound) as error:
        sys.stderr.write(f"Error: {error}\n")
        return 1
    sys.stdout.write(json.dumps(record, indent=2) + "\n")
    return 0


def _archive(said: argparse.Namespace) -> int:
    """Search modes for many people beforehand and write them into a task's response surface; finished work is kept."""
    work = said.work_directory or Settings().data_dir / "archive" / said.task
    try:
        record = archive_modes.archive(said.task, work, said.processes)
    except (archive_modes.NoSurface, NotExplored) as error:
        sys.stderr.write(f"Error: {error}\n")
        return 1
    sys.stdout.write(json.dumps(record, indent=2) + "\n")
    return 0


def _archive_policies(said: argparse.Namespace) -> int:
    """Refine policies beforehand, from which refinements begin; six to twenty minutes each, finished ones are kept."""
    work = said.work_directory or Settings().data_dir / "archive-policies" / said.task
    try:
        record = archive_policies.archive_policies(said.task, work)
    except (archive_policies.NothingToRefine, NotExplored) as error:
        sys.stderr.write(f"Error: {error}\n")
        return 1
    sys.stdout.write(json.dumps(record, indent=2) + "\n")
    return 0


def _archive_policies_in_modes(said: argparse.Namespace) -> int:
    """Try archived policies in modes that people would want, once for everybody; what was driven is kept."""
    work = said.work_directory or Settings().data_dir / "archive-policies-in-modes" / said.task
    try:
        record = archive_policies_in_modes.archive_policies_in_modes(said.task, work)
    except (archive_policies_in_modes.NoPolicies, NotExplored) as error:
        sys.stderr.write(f"Error: {error}\n")
        return 1
    sys.stdout.write(json.dumps(record, indent=2) + "\n")
    return 0


def _foresee(said: argparse.Namespace) -> int:
    """Train what foresees a task's signals from state and action, for who learns without measured signals."""
    record = train_signal_predictor.foresee(
        said.task,
        said.work_directory or Settings().data_dir / "foresight",
        said.processes,
        said.scenarios,
    )
    sys.stdout.write(json.dumps(record, indent=2) + "\n")
    return 0
