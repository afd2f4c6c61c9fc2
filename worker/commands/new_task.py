"""What somebody who adds a task needs (docs/new_task.md, docs/your_robot.md)."""

from pathlib import Path

from app.installed_tasks import catalogue
from worker.commands.arguments import Commands, add_task
from worker.experiments import behaviour_differences, check_lab, speed_cost_weight, start_posture


def add(commands: Commands) -> None:
    """Add ``start-posture``, ``speed-weight``, ``check`` and ``behaviours``."""
    posture = commands.add_parser("start-posture", help=start_posture.find_start_posture.__doc__)
    add_task(posture)
    posture.add_argument("--restarts", type=int, default=start_posture.RESTARTS, help="of inverse kinematics")
    posture.set_defaults(act=lambda said: start_posture.find_start_posture(said.task, said.restarts))

    speed = commands.add_parser("speed-weight", help=speed_cost_weight.weigh_speed.__doc__)
    add_task(speed)
    speed.add_argument("--scenarios", type=int, default=speed_cost_weight.SCENARIOS)
    speed.set_defaults(act=lambda said: speed_cost_weight.weigh_speed(said.task, said.scenarios))

    checking = commands.add_parser("check", help=check_lab.check.__doc__)
    checking.add_argument("file", type=Path, help="lab.toml, or the folder it lies in")
    checking.add_argument("--sheet", type=Path, help="the contact sheet; default: contact_sheet.png beside lab.toml")
    checking.set_defaults(act=lambda said: check_lab.check(said.file, said.sheet))

    differences = commands.add_parser("behaviours", help=behaviour_differences.tell_behaviours_apart.__doc__)
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
    differences.set_defaults(
        act=lambda said: behaviour_differences.tell_behaviours_apart(
            said.tasks, said.scenarios, said.axis_scenarios, said.steps
        )
    )
