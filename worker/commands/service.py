"""The service itself, and studies from recordings."""

import argparse
import sys
from pathlib import Path

from app.db import Database
from app.settings import Settings
from app.storage import ArtefactStore, keep_private
from worker.commands.arguments import Commands
from worker.jobs import service
from worker.jobs.clips import import_clips


def add(commands: Commands) -> None:
    """Add ``run`` and ``import-clips``."""
    serve = commands.add_parser("run", help=service.run.__doc__)
    serve.set_defaults(act=lambda _options: service.run(Settings()))

    clips = commands.add_parser("import-clips", help="make a study of your own recordings (docs/own_clips.md)")
    clips.add_argument("path", type=Path, help="folder or zip file")
    clips.set_defaults(act=_import_clips)


def _import_clips(said: argparse.Namespace) -> int:
    settings = Settings()
    keep_private(settings)
    database = Database(settings.sqlalchemy_url)
    try:
        slug = import_clips.import_clips(database, ArtefactStore.of(settings), said.path)
    finally:
        database.dispose()
    sys.stdout.write(f"Imported: {settings.base_url}/studies/{slug}\n")
    return 0
