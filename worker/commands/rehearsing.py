"""Studies with scripted participants: rehearsals, and the demo study that is shipped."""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from app.commands.parsers import Commands, add_command
from app.db import Database
from app.domain.choices import ClipQuality, Strategy
from app.domain.protocol import EvaluationSettings
from app.domain.study_settings import PAPER_PROTOCOL, StudySettings
from app.installed_tasks import lab
from app.installed_tasks.by_name import usual_behaviours
from app.services.archives import demo_archive
from app.storage import ArtefactStore
from worker.commands import options
from worker.commands.arguments import add_task
from worker.experiments.benchmark_cell import PAPER_USERS
from worker.ml.teachers import OF_LABS, LabTaste, Manner, Taste
from worker.rehearsal import demo_study, rehearsal
from worker.rehearsal.server import OwnStudio
from worker.tasks import registry

USUAL = StudySettings(strategy=Strategy.UNIFORM)
OF_SETTINGS: options.Table = {
    "labels_per_participant": ("--labels", "labels per participant"),
    "retrain_every_labels": ("--retrain-every", "labels between two reward models"),
    "filter_milestones": ("--milestones", "labels after which a filter is trained early"),
    "refinement_steps": ("--refinement-steps", "by which the last filter is refined"),
    "method": ("--method", "how the filter is trained"),
    "reward_kind": ("--reward", "the model that is learned from the labels"),
    "strategy": ("--strategy", "which pairs are asked"),
    "pooled_prior": ("--pooled-prior", "start from those who finished before"),
}
OF_EVALUATION: options.Table = {
    "methods": ("--methods", "to be rated, with --paper"),
    "trials": ("--trials", "of each method, with --paper"),
    "fine_tuning_steps": ("--fine-tuning-steps", "of PrefFT, with --paper"),
}
OF_MANNER: options.Table = {
    "rationality": ("--rationality", "log odds per typical difference; without it no doubt at all"),
    "myopia": ("--myopia", "below 1 the end of a clip weighs more"),
    "mistakes": ("--mistakes", "share of answers that say the opposite"),
    "equal_share": ("--equal", "share of pairs that are called equal"),
    "skip_share": ("--skip", "share of pairs called can't tell"),
}


def add(commands: Commands) -> None:
    """Add ``rehearse`` and ``demo-study``."""
    _add_rehearsal(commands)
    _add_demo_study(commands)


def _add_rehearsal(commands: Commands) -> None:
    rehearse = add_command(commands, "rehearse", _rehearse)
    add_task(rehearse)
    rehearse.add_argument(
        "--users",
        nargs="+",
        type=options.taste,
        default=[],
        help="names, or NAME=six weights; of a task of your own NAME=SIGNAL:WEIGHT,...; default: the paper's three",
    )
    rehearse.add_argument(
        "--omega", nargs=6, type=float, action="append", default=[], help="somebody with these six weights; repeatable"
    )
    rehearse.add_argument(
        "--paper",
        action="store_true",
        help="the paper's whole protocol: 200 labels unless said, robots rated in the end",
    )
    rehearse.add_argument(
        "--settings",
        type=Path,
        help="a study of these settings, in a file as the API has them; instead of most options",
    )
    options.add(rehearse, OF_SETTINGS, USUAL, only_said=True)
    options.add(rehearse, OF_EVALUATION, EvaluationSettings())
    rehearse.add_argument("--clip-scenarios", type=int, help="size of the pool; default: just enough pairs")
    options.add(rehearse, OF_MANNER, Manner(skip_share=0.02))  # so that skipping is rehearsed as well
    rehearse.add_argument("--pace", type=float, default=0.0, help="seconds of thought per pair")
    rehearse.add_argument("--seed", type=int, default=0)
    rehearse.add_argument("--directory", type=Path, help="keep everything here; default: a temporary directory")


def _add_demo_study(commands: Commands) -> None:
    command = add_command(commands, "demo-study", _make_demo_study, demo_study.__doc__)
    command.add_argument(
        "--output", type=Path, default=demo_archive.ARCHIVE, help="the archive; default: what is shipped"
    )
    command.add_argument("--seed", type=int, default=demo_study.SEED)


def _rehearse(said: argparse.Namespace) -> int:
    """Send scripted participants through the real pages and print what came out."""
    settings, tastes = settings_of(said), _tastes(said)
    try:
        _require_fitting(tastes, said.task)
    except (ValueError, registry.NotExplored) as error:
        sys.stderr.write(f"Error: {error}\n")
        return 1
    with tempfile.TemporaryDirectory(prefix="rehearsal-") as temporary:
        directory = said.directory or Path(temporary)
        with OwnStudio(directory) as studio:
            database = Database(studio.settings.sqlalchemy_url)
            store = ArtefactStore(directory / "artefacts")
            rehearsed = rehearsal.Rehearsal(database, store, studio.settings.base_url, said.pace)
            done = rehearsed.run(said.task, tastes, settings, _manner(said), said.seed)
            database.dispose()
        rehearsal.write(done, directory / "rehearsed")
        sys.stdout.write(rehearsal.summary(done) + "\n")
        if said.directory:
            sys.stdout.write(f"Figures, tables, bundles and numbers are in {directory / 'rehearsed'}\n")
    return 0


def _make_demo_study(said: argparse.Namespace) -> int:
    """Make the study that the studio imports at its first start, anew."""
    with tempfile.TemporaryDirectory(prefix="demo-study-") as directory:
        rehearsed = demo_study.make(said.output, Path(directory), said.seed)
    sys.stdout.write(rehearsal.summary(rehearsed) + "\n")
    sys.stdout.write(f"{said.output}: {said.output.stat().st_size / 1e6:.1f} MB\n")
    return 0


def _tastes(said: argparse.Namespace) -> list[Taste]:
    """Whoever was asked for; the paper's three when nobody was."""
    own = [Taste.of_omega(omega) for omega in said.omega]
    of_nobody = PAPER_USERS.values() if registry.lab(said.task) is None else OF_LABS
    return [*said.users, *own] or list(of_nobody)


def _require_fitting(tastes: Sequence[Taste], name: str) -> None:
    """Raises ValueError for people who mind what the task does not have, NotExplored."""
    task = registry.task(name)
    for taste in tastes:
        if isinstance(taste, LabTaste) is not task.is_a_labs:
            raise ValueError(
                f"{taste.name} is nobody who knows {name}. Say what they mind of its signals, below 0 what they like: "
                f"--users quick=undelivered:1 (there are {', '.join(task.signals)})."
                if task.is_a_labs
                else f"{taste.name} minds signals alone, and {name} wants six weights before them: NAME=six,weights,..."
            )
        if isinstance(taste, LabTaste):
            taste.step_rewards(np.zeros(len(task.signals)), task.signals)
    if task.is_a_labs and not lab.whole(registry.installed_task(name)):
        raise registry.NotExplored(
            f"The ways to do {name} are half explored: python -m worker explore --task {name} goes on where it was."
        )


def _manner(said: argparse.Namespace) -> Manner:
    return options.filled(Manner(), OF_MANNER, said)


def settings_of(said: argparse.Namespace) -> StudySettings:
    """Those of the rehearsed study: what was said, else the usual or the paper's. Raises ValidationError, OSError."""
    if said.settings is not None:
        return StudySettings.model_validate_json(said.settings.read_bytes())
    usual = PAPER_PROTOCOL if said.paper else USUAL
    chosen = {name: value for name in OF_SETTINGS if (value := getattr(said, name)) is not None}
    chosen["clip_quality"] = ClipQuality.QUICK  # nobody looks at them
    labels = chosen.get("labels_per_participant", usual.labels_per_participant)
    ways = usual_behaviours(said.task, usual.behaviours_per_scenario)
    chosen["behaviours_per_scenario"] = ways
    chosen["pool_scenarios"] = said.clip_scenarios or -(-labels // (ways * (ways - 1) // 2))
    if registry.lab(said.task) is not None:
        chosen["clip_steps"] = registry.installed_task(said.task).description.usual_clip_steps
    if said.paper:
        chosen["introduction_pairs"] = min(usual.introduction_pairs, labels)
        chosen["evaluation"] = EvaluationSettings(**{name: getattr(said, name) for name in OF_EVALUATION})
    return StudySettings(**{**usual.model_dump(), **chosen})
