"""What a task needs once for everybody: a reference policy, a response surface, foresight."""

import argparse
import json
import sys
from pathlib import Path

from app.settings import Settings
from worker.commands.arguments import Commands, add_processes, add_task
from worker.experiments import (
    archive_modes,
    archive_policies,
    fit_response_surface,
    pretrain_policy,
    train_signal_predictor,
)
from worker.ml.policies.onnx_policy import NotAPolicy
from worker.sim.lab.errors import LabTaskBroken
from worker.tasks.registry import NotExplored, checkpoint


def add(commands: Commands) -> None:
    """Add ``pretrain``, ``explore``, ``archive``, ``archive-policies`` and ``foresee``."""
    pretrain = commands.add_parser("pretrain", help=pretrain_policy.pretrain.__doc__)
    add_task(pretrain)
    pretrain.add_argument("--seed", type=int, default=0)
    pretrain.add_argument("--directory", type=Path, help="where the policy goes; default: where the studio keeps it")
    pretrain.set_defaults(act=_pretrain)

    explore = commands.add_parser("explore", help=fit_response_surface.explore.__doc__)
    add_task(explore)
    explore.add_argument("--work-directory", type=Path, help="finished blocks; default: explore/ in the data directory")
    explore.add_argument("--scenarios", type=int, default=fit_response_surface.SCENARIOS, help="each in twelve modes")
    explore.add_argument("--sought", type=int, help="scenarios of every later round; default: a fifth of the first's")
    add_processes(explore)
    explore.set_defaults(act=_explore)

    archive = commands.add_parser("archive", help=archive_modes.archive.__doc__)
    add_task(archive)
    archive.add_argument("--work-directory", type=Path, help="finished blocks; default: archive/ in the data directory")
    add_processes(archive)
    archive.set_defaults(act=_archive)

    policies = commands.add_parser("archive-policies", help=archive_policies.archive_policies.__doc__)
    add_task(policies)
    policies.add_argument(
        "--work-directory", type=Path, help="finished policies; default: archive-policies/ in the data directory"
    )
    policies.set_defaults(act=_archive_policies)

    foresee = commands.add_parser("foresee", help=train_signal_predictor.foresee.__doc__)
    add_task(foresee)
    foresee.add_argument("--work-directory", type=Path, help="rollouts; default: foresight/ in the data directory")
    foresee.add_argument(
        "--scenarios", type=int, default=train_signal_predictor.SCENARIOS, help="each in six behaviours"
    )
    add_processes(foresee)
    foresee.set_defaults(act=_foresee)


def _pretrain(said: argparse.Namespace) -> int:
    return pretrain_policy.pretrain(said.task, said.seed, said.directory or checkpoint(said.task))


def _explore(said: argparse.Namespace) -> int:
    work = said.work_directory or Settings().data_dir / "explore" / said.task
    try:
        record = fit_response_surface.explore(said.task, work, said.processes, said.scenarios, said.sought)
    except (LabTaskBroken, NotAPolicy, fit_response_surface.NoRound) as error:
        sys.stderr.write(f"Error: {error}\n")
        return 1
    sys.stdout.write(json.dumps(record, indent=2) + "\n")
    return 0


def _archive(said: argparse.Namespace) -> int:
    work = said.work_directory or Settings().data_dir / "archive" / said.task
    try:
        record = archive_modes.archive(said.task, work, said.processes)
    except (archive_modes.NoSurface, NotExplored) as error:
        sys.stderr.write(f"Error: {error}\n")
        return 1
    sys.stdout.write(json.dumps(record, indent=2) + "\n")
    return 0


def _archive_policies(said: argparse.Namespace) -> int:
    work = said.work_directory or Settings().data_dir / "archive-policies" / said.task
    try:
        record = archive_policies.archive_policies(said.task, work)
    except (archive_policies.NothingToRefine, NotExplored) as error:
        sys.stderr.write(f"Error: {error}\n")
        return 1
    sys.stdout.write(json.dumps(record, indent=2) + "\n")
    return 0


def _foresee(said: argparse.Namespace) -> int:
    record = train_signal_predictor.foresee(
        said.task,
        said.work_directory or Settings().data_dir / "foresight",
        said.processes,
        said.scenarios,
    )
    sys.stdout.write(json.dumps(record, indent=2) + "\n")
    return 0
