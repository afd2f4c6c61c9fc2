"""What the worker can be told to do: serve, train the reference policy, explore the modes, rehearse a study."""

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from app.db import Database
from app.domain.choices import ClipQuality, Strategy
from app.domain.protocol import EvaluationSettings
from app.domain.study_settings import PAPER_PROTOCOL, StudySettings
from app.installed_tasks import catalogue
from app.services.archives import demo_archive
from app.settings import Settings
from app.storage import ArtefactStore, keep_private
from worker import options
from worker.experiments import (
    behaviour_differences,
    benchmark,
    check_lab,
    fit_response_surface,
    pretrain_policy,
    speed_cost_weight,
    start_posture,
    train_signal_predictor,
)
from worker.experiments.benchmark_cell import INDIRECT_USERS, OPPOSED_USERS, PAPER_USERS
from worker.jobs import service
from worker.jobs.clips import import_clips
from worker.ml.methods.registry import METHODS
from worker.ml.policies.onnx_policy import NotAPolicy
from worker.ml.teachers import Manner, Taste
from worker.rehearsal import demo_study, rehearsal
from worker.rehearsal.server import OwnStudio
from worker.sim.lab.errors import LabTaskBroken
from worker.tasks.registry import checkpoint


def run(arguments: Sequence[str] | None) -> int:
    """Parse the command line and do what it says; returns the exit code."""
    for task in catalogue.installed().broken:
        sys.stderr.write(f"{task.why}\n")
    said = parser().parse_args(arguments)
    result: int = said.act(said)
    return result


def parser() -> argparse.ArgumentParser:
    """What can be said on the command line."""
    whole = argparse.ArgumentParser(prog="python -m worker", description="The worker of PbARL Studio and its tools.")
    commands = whole.add_subparsers(dest="command", required=True)
    _add_service(commands)
    _add_training(commands)
    _add_new_task(commands)
    _add_benchmark(commands)
    _add_rehearsal(commands)
    _add_demo_study(commands)
    return whole


_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def _add_service(commands: _Commands) -> None:
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


def _add_training(commands: _Commands) -> None:
    pretrain = commands.add_parser("pretrain", help=pretrain_policy.pretrain.__doc__)
    _add_task(pretrain)
    pretrain.add_argument("--seed", type=int, default=0)
    pretrain.add_argument("--directory", type=Path, help="where the policy goes; default: where the studio keeps it")
    pretrain.set_defaults(act=_pretrain)

    explore = commands.add_parser("explore", help=fit_response_surface.explore.__doc__)
    _add_task(explore)
    explore.add_argument("--work-directory", type=Path, help="finished blocks; default: explore/ in the data directory")
    explore.add_argument("--scenarios", type=int, default=fit_response_surface.SCENARIOS, help="each in twelve modes")
    _add_processes(explore)
    explore.set_defaults(act=_explore)

    foresee = commands.add_parser("foresee", help=train_signal_predictor.foresee.__doc__)
    _add_task(foresee)
    foresee.add_argument("--work-directory", type=Path, help="rollouts; default: foresight/ in the data directory")
    foresee.add_argument(
        "--scenarios", type=int, default=train_signal_predictor.SCENARIOS, help="each in six behaviours"
    )
    _add_processes(foresee)
    foresee.set_defaults(act=_foresee)


def _add_new_task(commands: _Commands) -> None:
    """What somebody who adds a task needs (docs/new_task.md)."""
    posture = commands.add_parser("start-posture", help=start_posture.find_start_posture.__doc__)
    _add_task(posture)
    posture.add_argument("--restarts", type=int, default=start_posture.RESTARTS, help="of inverse kinematics")
    posture.set_defaults(act=lambda said: start_posture.find_start_posture(said.task, said.restarts))

    speed = commands.add_parser("speed-weight", help=speed_cost_weight.weigh_speed.__doc__)
    _add_task(speed)
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


OF_TERMS: options.Table = {
    "labels": ("--labels", "the paper's offline training has 5000"),
    "scenarios": ("--scenarios", "unseen ones"),
    "reward": ("--reward", "the model that is learned from the labels"),
    "rule": ("--rule", "which pairs are asked"),
    "form": ("--form", "of the costs"),
    "manner.mistakes": ("--mistakes", "share of answers that say the opposite"),
    "manner.rationality": ("--rationality", "beta per spread of returns; without it users name the better clip"),
    "methods.fine_tuning.steps": ("--prefft-steps", "environment steps of PrefFT, as in the paper"),
    "methods.from_scratch.steps": ("--pbrl-steps", "environment steps of PbRL-HRI"),
    "methods.printed_steps": ("--printed-steps", "gradient steps of the printed method"),
}


def _add_benchmark(commands: _Commands) -> None:
    usual = benchmark.Selection()
    command = commands.add_parser("benchmark", help=benchmark.__doc__, formatter_class=argparse.RawTextHelpFormatter)
    command.add_argument("--profile", choices=list(benchmark.PROFILES), default="full")
    command.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(usual.methods))
    command.add_argument("--tasks", nargs="+", choices=catalogue.names(), default=list(usual.tasks))
    command.add_argument(
        "--users",
        nargs="+",
        type=options.taste,
        default=list(usual.tastes),
        help="names, or NAME=six weights and costs per signal: shy=1,3,2,2,1,1 or level=1,1,1,1,1,1,tilt_rad:0.3",
    )
    command.add_argument("--opposed", action="store_true", help="also the six users who truly differ")
    command.add_argument(
        "--indirect", action="store_true", help="also three users whose taste no mode axis moves directly"
    )
    command.add_argument("--population", type=int, default=0, help="also so many users drawn at random")
    command.add_argument("--seeds", type=int, default=usual.seeds)
    options.add(command, OF_TERMS, benchmark.PROFILES["full"], only_said=True)
    _add_processes(command)
    command.add_argument(
        "--work-directory", type=Path, help="finished cells; default: benchmark/ in the data directory"
    )
    command.add_argument(
        "--output", type=Path, help="tables; default: docs/results/all_methods, or inside the work directory if quick"
    )
    command.add_argument("--report-only", action="store_true", help="run nothing, write the tables from what there is")
    command.set_defaults(act=_benchmark)


def _benchmark(said: argparse.Namespace) -> int:
    terms = options.filled(benchmark.PROFILES[said.profile], OF_TERMS, said)
    others = [
        *(OPPOSED_USERS.values() if said.opposed else ()),
        *(INDIRECT_USERS.values() if said.indirect else ()),
        *benchmark.population(said.population),
    ]
    tastes = {taste.name: taste for taste in [*said.users, *others]}
    selection = benchmark.Selection(said.methods, said.tasks, tuple(tastes.values()), said.seeds)
    work = said.work_directory or Settings().data_dir / "benchmark"
    output = said.output or (work / "quick" if said.profile == "quick" else Path("docs/results/all_methods"))
    command = "python -m worker " + " ".join(sys.argv[1:] or ["benchmark"])
    return benchmark.benchmark(selection, terms, work, output, said.processes, command, not said.report_only)


OF_SETTINGS: options.Table = {
    "labels_per_participant": ("--labels", "labels per participant"),
    "retrain_every_labels": ("--retrain-every", "labels between two reward models"),
    "filter_milestones": ("--milestones", "labels after which a filter is trained early"),
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


def _add_rehearsal(commands: _Commands) -> None:
    rehearse = commands.add_parser("rehearse", help=_rehearse.__doc__)
    _add_task(rehearse)
    rehearse.add_argument(
        "--users",
        nargs="+",
        type=options.taste,
        default=[],
        help="names, or NAME=six weights; default: the paper's three",
    )
    rehearse.add_argument(
        "--omega", nargs=6, type=float, action="append", default=[], help="somebody with these six weights; repeatable"
    )
    rehearse.add_argument("--paper", action="store_true", help="the paper's whole protocol, robots rated in the end")
    options.add(rehearse, OF_SETTINGS, StudySettings(strategy=Strategy.UNIFORM))
    options.add(rehearse, OF_EVALUATION, EvaluationSettings())
    rehearse.add_argument("--clip-scenarios", type=int, help="size of the pool; default: just enough pairs")
    options.add(rehearse, OF_MANNER, Manner(skip_share=0.02))  # so that skipping is rehearsed as well
    rehearse.add_argument("--pace", type=float, default=0.0, help="seconds of thought per pair")
    rehearse.add_argument("--seed", type=int, default=0)
    rehearse.add_argument("--directory", type=Path, help="keep everything here; default: a temporary directory")
    rehearse.set_defaults(act=_rehearse)


def _add_demo_study(commands: _Commands) -> None:
    command = commands.add_parser("demo-study", help=demo_study.__doc__, formatter_class=argparse.RawTextHelpFormatter)
    command.add_argument(
        "--output", type=Path, default=demo_archive.ARCHIVE, help="the archive; default: what is shipped"
    )
    command.add_argument("--seed", type=int, default=demo_study.SEED)
    command.set_defaults(act=_make_demo_study)


def _add_processes(command: argparse.ArgumentParser) -> None:
    command.add_argument("--processes", type=int, default=2)


def _add_task(command: argparse.ArgumentParser) -> None:
    command.add_argument("--task", choices=catalogue.names(), default=catalogue.usual())


def _pretrain(said: argparse.Namespace) -> int:
    return pretrain_policy.pretrain(said.task, said.seed, said.directory or checkpoint(said.task))


def _explore(said: argparse.Namespace) -> int:
    work = said.work_directory or Settings().data_dir / "explore" / said.task
    try:
        record = fit_response_surface.explore(said.task, work, said.processes, said.scenarios)
    except (LabTaskBroken, NotAPolicy) as error:
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


def _rehearse(said: argparse.Namespace) -> int:
    """Send scripted participants through the real pages and print what came out."""
    settings = _settings(said)
    with tempfile.TemporaryDirectory(prefix="rehearsal-") as temporary:
        directory = said.directory or Path(temporary)
        with OwnStudio(directory) as studio:
            database = Database(studio.settings.sqlalchemy_url)
            store = ArtefactStore(directory / "artefacts")
            rehearsed = rehearsal.Rehearsal(database, store, studio.settings.base_url, said.pace)
            done = rehearsed.run(said.task, _tastes(said), settings, _manner(said), said.seed)
            database.dispose()
        rehearsal.write(done, directory / "rehearsed")
        sys.stdout.write(rehearsal.summary(done) + "\n")
        if said.directory:
            sys.stdout.write(f"Figures, tables, bundles and numbers are in {directory / 'rehearsed'}\n")
    return 0


def _make_demo_study(said: argparse.Namespace) -> int:
    with tempfile.TemporaryDirectory(prefix="demo-study-") as directory:
        rehearsed = demo_study.make(said.output, Path(directory), said.seed)
    sys.stdout.write(rehearsal.summary(rehearsed) + "\n")
    sys.stdout.write(f"{said.output}: {said.output.stat().st_size / 1e6:.1f} MB\n")
    return 0


def _tastes(said: argparse.Namespace) -> list[Taste]:
    """Whoever was asked for; the paper's three when nobody was."""
    own = [Taste.of_omega(omega) for omega in said.omega]
    return [*said.users, *own] or list(PAPER_USERS.values())


def _manner(said: argparse.Namespace) -> Manner:
    return options.filled(Manner(), OF_MANNER, said)


def _settings(said: argparse.Namespace) -> StudySettings:
    chosen = {name: getattr(said, name) for name in OF_SETTINGS}
    chosen["clip_quality"] = ClipQuality.QUICK  # nobody looks at them
    enough = -(-said.labels_per_participant // StudySettings().pairs_per_scenario)
    chosen["pool_scenarios"] = said.clip_scenarios or enough
    if not said.paper:
        return StudySettings(**chosen)
    chosen["introduction_pairs"] = min(PAPER_PROTOCOL.introduction_pairs, said.labels_per_participant)
    chosen["evaluation"] = EvaluationSettings(**{name: getattr(said, name) for name in OF_EVALUATION})
    return StudySettings(**{**PAPER_PROTOCOL.model_dump(), **chosen})
