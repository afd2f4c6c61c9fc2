"""The service itself, and studies from recordings."""

import argparse
import sys
from pathlib import Path

from app import upgrading
from app.commands.parsers import Commands, add_command
from app.db import Database
from app.settings import Settings
from app.storage import ArtefactStore, keep_private
from worker.jobs import service
from worker.jobs.clips import import_clips
from worker.jobs.clips.own_clips import Choices


def add(commands: Commands) -> None:
    """Add ``run`` and ``import-clips``."""
    add_command(commands, "run", _run)
    clips = add_command(commands, "import-clips", _import_clips)
    clips.add_argument("path", type=Path, help="folder or zip file of your own, LeRobotDataset v3, or RoboArena dump")
    clips.add_argument("--name", help="of the study")
    clips.add_argument("--camera", help="which of several is shown")
    clips.add_argument("--episodes", type=_range, metavar="FIRST:END", help="of a LeRobotDataset, as in Python")
    clips.add_argument("--signals", type=_listed, default=(), metavar="FEATURE,...", help="what people may judge by")
    clips.add_argument("--rate", type=int, default=Choices.rate_hz, help="steps per second of a RoboArena dump")


def _range(text: str) -> range:
    first, _, end = text.partition(":")
    return range(int(first), int(end))


def _listed(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


def _run(_said: argparse.Namespace) -> int:
    """Keep studies supplied with clips, queries, models and bundles until told to stop."""
    return service.run(Settings())


def _import_clips(said: argparse.Namespace) -> int:
    """Make a study of your own recordings (docs/own_clips.md)."""
    settings = Settings()
    keep_private(settings)
    upgrading.upgrade(settings)
    database = Database(settings.sqlalchemy_url)
    choices = Choices(said.name, said.camera, said.episodes, said.signals, said.rate)
    try:
        slug = import_clips.import_clips(database, ArtefactStore.of(settings), said.path, choices)
    finally:
        database.dispose()
    sys.stdout.write(f"Imported: {settings.base_url}/studies/{slug}\n")
    return 0
