"""Tools of the worker that need no database: training the reference policy, exploring the modes."""

import argparse
from pathlib import Path

from worker import laboratory


def add_to(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Register every tool."""
    pretrain = commands.add_parser("pretrain", help=laboratory.pretrain.__doc__)
    pretrain.add_argument("--seed", type=int, default=0)
    pretrain.add_argument("--directory", type=Path, default=laboratory.CHECKPOINTS, help="where the policy goes")
    pretrain.set_defaults(act=lambda options: laboratory.pretrain(options.seed, options.directory))
