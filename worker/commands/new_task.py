"""What somebody who adds a task needs (docs/new_task.md, docs/your_robot.md)."""

import argparse
from pathlib import Path

from app.commands.parsers import Commands, add_command
from app.installed_tasks import catalogue
from worker.commands.arguments import add_task
from worker.experiments import behaviour_differences, check_lab, speed_cost_weight, start_posture


def add(commands: Commands) -> None:
    """Add ``start-posture``, ``speed-weight``, ``check`` and ``behaviours``."""
    posture = add_command(commands, "start-posture", _start_posture)
    add_task(posture)
    posture.add_argument("--restarts", type=int, default=start_posture.RESTARTS, help="of inverse kinematics")

    speed = add_command(commands, "speed-weight", _speed_weight)
    add_task(speed)
    speed.add_argument("--scenarios", type=int, default=speed_cost_weight.SCENARIOS)

    checking = add_command(commands, "check", _check)
    checking.add_argument("file", type=Path, help="lab.toml, or the folder it lies in")
    checking.add_argument("--sheet", type=Path, help="the contact sheet; default: contact_sheet.png beside lab.toml")

    differences = add_command(commands, "behaviours", _behaviours)
    differences.add_argument("--tasks", nargs="+", choices=catalogue.names(), default=list(catalogue.names()))
    differences.add_argument("--scenarios", type=int, default=behaviour_differences.SCENARIOS)
    differences.add_argument(
        "--axis-scenarios",
        type=int,
        default=behaviour_differences.AXIS_SCENARIOS,
        help="in which the ends of the axes are tried",
    )
    differences.add_argument(
        "--steps",
        type=int,
        nargs="+",
        default=list(behaviour_differences.SHOWN_STEPS),
        help="control steps shown, from the start",
    )


def _start_posture(said: argparse.Namespace) -> int:
    """Print the five best postures for a task's start: score, clearance in m, angles in rad (seconds)."""
    return start_posture.find_start_posture(said.task, said.restarts)


def _speed_weight(said: argparse.Namespace) -> int:
    """Print what each cost sums to at every speed, and the weight of speed that follows (about a minute)."""
    return speed_cost_weight.weigh_speed(said.task, said.scenarios)


def _check(said: argparse.Namespace) -> int:
    """Say what is missing or wrong in a lab.toml, run three episodes and write a contact sheet (docs/your_robot.md)."""
    return check_lab.check(said.file, said.sheet)


def _behaviours(said: argparse.Namespace) -> int:
    """Print how often each task succeeds, what every mode axis does, and how often users prefer the same clip."""
    return behaviour_differences.tell_behaviours_apart(said.tasks, said.scenarios, said.axis_scenarios, said.steps)
