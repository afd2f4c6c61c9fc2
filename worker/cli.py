"""What the worker can be told to do: serve, train the reference policy, explore the modes, rehearse a study."""

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import TypeAlias, get_args

from app.db import Database
from app.domain.protocol import EvaluationSettings
from app.domain.studies import PAPER_PROTOCOL, ClipQuality, Method, RewardKind, Strategy, StudySettings
from app.services.archives import demo_archive
from app.settings import Settings
from app.storage import ArtefactStore, keep_private
from installed_tasks import catalogue
from worker.experiments import benchmark, fit_response_surface, pretrain_policy, train_signal_predictor
from worker.experiments.benchmark_cell import INDIRECT_USERS, OPPOSED_USERS, PAPER_USERS
from worker.jobs import service
from worker.jobs.clips import import_clips
from worker.ml import acquisition
from worker.ml.methods.registry import METHODS
from worker.ml.rewards import reward_training
from worker.ml.teachers import TASTES, Manner, Taste
from worker.rehearsal import demo_study, rehearsal
from worker.rehearsal.server import OwnStudio
from worker.tasks.registry import checkpoint


def run(arguments: Sequence[str] | None) -> int:
    """Parse the command line and do what it says; returns the exit code."""
    for task in catalogue.installed().broken:
        sys.stderr.write(f"{task.why}\n")
    options = parser().parse_args(arguments)
    result: int = options.act(options)
    return result


def parser() -> argparse.ArgumentParser:
    """What can be said on the command line."""
    whole = argparse.ArgumentParser(prog="python -m worker", description="The worker of PbARL Studio and its tools.")
    commands = whole.add_subparsers(dest="command", required=True)
    _add_service(commands)
    _add_training(commands)
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


def _import_clips(options: argparse.Namespace) -> int:
    settings = Settings()
    keep_private(settings)
    database = Database(settings.sqlalchemy_url)
    slug = import_clips.import_clips(database, ArtefactStore(settings.data_dir / "artefacts"), options.path)
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
    explore.add_argument("--processes", type=int, default=2)
    explore.set_defaults(act=_explore)

    foresee = commands.add_parser("foresee", help=train_signal_predictor.foresee.__doc__)
    _add_task(foresee)
    foresee.add_argument("--work-directory", type=Path, help="rollouts; default: foresight/ in the data directory")
    foresee.add_argument(
        "--scenarios", type=int, default=train_signal_predictor.SCENARIOS, help="each in six behaviours"
    )
    foresee.add_argument("--processes", type=int, default=2)
    foresee.set_defaults(act=_foresee)


def _add_benchmark(commands: _Commands) -> None:
    command = commands.add_parser("benchmark", help=benchmark.__doc__, formatter_class=argparse.RawTextHelpFormatter)
    command.add_argument("--profile", choices=list(benchmark.PROFILES), default="full")
    command.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    command.add_argument("--tasks", nargs="+", choices=catalogue.names(), default=catalogue.names())
    command.add_argument(
        "--users",
        nargs="+",
        type=_taste,
        default=list(PAPER_USERS.values()),
        help="names, or NAME=six weights and costs per signal: shy=1,3,2,2,1,1 or level=1,1,1,1,1,1,tilt_rad:0.3",
    )
    command.add_argument("--opposed", action="store_true", help="also the six users who truly differ")
    command.add_argument(
        "--indirect", action="store_true", help="also three users whose taste no mode axis moves directly"
    )
    command.add_argument("--population", type=int, default=0, help="also so many users drawn at random")
    command.add_argument("--seeds", type=int, default=1)
    command.add_argument("--labels", type=int, help="200; the paper's offline training has 5000")
    command.add_argument("--scenarios", type=int, help="unseen ones; 500")
    command.add_argument("--reward", choices=get_args(reward_training.RewardKind))
    command.add_argument("--rule", choices=get_args(acquisition.Strategy), help="which pairs are asked; entropy")
    command.add_argument("--form", choices=["calibrated", "paper"], help="of the costs")
    command.add_argument("--mistakes", type=_share, help="share of answers that say the opposite; 0.05")
    command.add_argument(
        "--rationality",
        type=_positive,
        help="beta per spread of returns; without it users name the better clip",
    )
    command.add_argument("--prefft-steps", type=int, help="environment steps of PrefFT; 100000 as in the paper")
    command.add_argument("--pbrl-steps", type=int, help="environment steps of PbRL-HRI; 260000")
    command.add_argument("--printed-steps", type=int, help="gradient steps of the printed method; 3000")
    command.add_argument("--processes", type=int, default=2)
    command.add_argument(
        "--work-directory", type=Path, help="finished cells; default: benchmark/ in the data directory"
    )
    command.add_argument(
        "--output", type=Path, help="tables; default: docs/results, or inside the work directory if quick"
    )
    command.add_argument("--report-only", action="store_true", help="run nothing, write the tables from what there is")
    command.set_defaults(act=_benchmark)


def _share(text: str) -> float:
    """A number from 0 to 1."""
    value = float(text)
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"{text} is no share; give a number from 0 to 1.")
    return value


def _positive(text: str) -> float:
    """A finite number above 0."""
    value = float(text)
    if not (value > 0.0 and isfinite(value)):
        raise argparse.ArgumentTypeError(f"{text} must be a number above 0.")
    return value


def _taste(text: str) -> Taste:
    """A known user, or somebody with weights of their own: six for omega, then signal:weight as often as wanted."""
    name, _, weights = text.partition("=")
    if not weights and name in TASTES:
        return TASTES[name]
    omega = [part for part in weights.split(",") if ":" not in part]
    signals = [part.split(":", 1) for part in weights.split(",") if ":" in part]
    try:
        if not name.replace("-", "").isalnum() or name in TASTES:
            raise ValueError(f"A user of one's own needs a new name of letters, digits and hyphens; got {name!r}.")
        per_signal = {signal: float(weight) for signal, weight in signals}
        return Taste(name, tuple(float(weight) for weight in omega), per_signal)
    except ValueError as error:
        known = ", ".join(TASTES)
        raise argparse.ArgumentTypeError(f"{text!r} is none of {known}, nor NAME=six,weights,...: {error}") from error


def _benchmark(options: argparse.Namespace) -> int:
    terms = benchmark.with_options(
        benchmark.PROFILES[options.profile],
        labels=options.labels,
        scenarios=options.scenarios,
        reward=options.reward,
        rule=options.rule,
        form=options.form,
        mistakes=options.mistakes,
        rationality=options.rationality,
        prefft_steps=options.prefft_steps,
        pbrl_steps=options.pbrl_steps,
        printed_steps=options.printed_steps,
    )
    others = [
        *(OPPOSED_USERS.values() if options.opposed else ()),
        *(INDIRECT_USERS.values() if options.indirect else ()),
        *benchmark.population(options.population),
    ]
    tastes = {taste.name: taste for taste in [*options.users, *others]}
    selection = benchmark.Selection(options.methods, options.tasks, tuple(tastes.values()), options.seeds)
    work = options.work_directory or Settings().data_dir / "benchmark"
    output = options.output or (work / "quick" if options.profile == "quick" else Path("docs/results"))
    command = "python -m worker " + " ".join(sys.argv[1:] or ["benchmark"])
    return benchmark.benchmark(selection, terms, work, output, options.processes, command, not options.report_only)


def _add_rehearsal(commands: _Commands) -> None:
    rehearse = commands.add_parser("rehearse", help=_rehearse.__doc__)
    _add_task(rehearse)
    rehearse.add_argument(
        "--users", nargs="+", type=_taste, default=[], help="names, or NAME=six weights; default: the paper's three"
    )
    rehearse.add_argument(
        "--omega", nargs=6, type=float, action="append", default=[], help="somebody with these six weights; repeatable"
    )
    rehearse.add_argument("--labels", type=int, default=200, help="labels per participant")
    rehearse.add_argument("--paper", action="store_true", help="the paper's whole protocol, robots rated in the end")
    rehearse.add_argument("--fine-tuning-steps", type=int, default=100_000, help="of PrefFT, with --paper")
    rehearse.add_argument("--retrain-every", type=int, default=10)
    milestones = StudySettings.model_fields["filter_milestones"].default
    rehearse.add_argument(
        "--milestones",
        nargs="*",
        type=int,
        default=list(milestones),
        help="labels after which a filter is trained early",
    )
    rehearse.add_argument("--clip-scenarios", type=int, help="size of the pool; default: just enough pairs")
    rehearse.add_argument("--method", type=Method, choices=list(Method), default=Method.STUDIO)
    rehearse.add_argument("--reward", type=RewardKind, choices=list(RewardKind), default=RewardKind.STRUCTURED)
    rehearse.add_argument("--strategy", type=Strategy, choices=list(Strategy), default=Strategy.UNIFORM)
    rehearse.add_argument("--pooled-prior", action="store_true", help="start from those who finished before")
    rehearse.add_argument(
        "--rationality", type=_positive, help="log odds per typical difference; default: no doubt at all"
    )
    rehearse.add_argument("--myopia", type=float, default=1.0, help="below 1 the end of a clip weighs more")
    rehearse.add_argument("--mistakes", type=_share, default=0.05, help="share of answers that say the opposite")
    rehearse.add_argument("--equal", type=float, default=0.10, help="share of pairs that are called equal")
    rehearse.add_argument("--skip", type=float, default=0.02, help="share of pairs called can't tell")
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


def _add_task(command: argparse.ArgumentParser) -> None:
    command.add_argument("--task", choices=catalogue.names(), default=catalogue.usual())


def _pretrain(options: argparse.Namespace) -> int:
    return pretrain_policy.pretrain(options.task, options.seed, options.directory or checkpoint(options.task))


def _explore(options: argparse.Namespace) -> int:
    record = fit_response_surface.explore(
        options.task,
        options.work_directory or Settings().data_dir / "explore" / options.task,
        options.processes,
        options.scenarios,
    )
    sys.stdout.write(json.dumps(record, indent=2) + "\n")
    return 0


def _foresee(options: argparse.Namespace) -> int:
    record = train_signal_predictor.foresee(
        options.task,
        options.work_directory or Settings().data_dir / "foresight",
        options.processes,
        options.scenarios,
    )
    sys.stdout.write(json.dumps(record, indent=2) + "\n")
    return 0


def _rehearse(options: argparse.Namespace) -> int:
    """Send scripted participants through the real pages and print what came out."""
    with tempfile.TemporaryDirectory(prefix="rehearsal-") as temporary:
        directory = options.directory or Path(temporary)
        with OwnStudio(directory) as studio:
            database = Database(studio.settings.sqlalchemy_url)
            store = ArtefactStore(directory / "artefacts")
            rehearsed = rehearsal.Rehearsal(database, store, studio.settings.base_url, options.pace)
            done = rehearsed.run(options.task, _tastes(options), _settings(options), _manner(options), options.seed)
            database.dispose()
        rehearsal.write(done, directory / "rehearsed")
        sys.stdout.write(rehearsal.summary(done) + "\n")
        if options.directory:
            sys.stdout.write(f"Figures, tables, bundles and numbers are in {directory / 'rehearsed'}\n")
    return 0


def _make_demo_study(options: argparse.Namespace) -> int:
    with tempfile.TemporaryDirectory(prefix="demo-study-") as directory:
        rehearsed = demo_study.make(options.output, Path(directory), options.seed)
    sys.stdout.write(rehearsal.summary(rehearsed) + "\n")
    sys.stdout.write(f"{options.output}: {options.output.stat().st_size / 1e6:.1f} MB\n")
    return 0


def _tastes(options: argparse.Namespace) -> list[Taste]:
    """Whoever was asked for; the paper's three when nobody was."""
    own = [Taste.of_omega(omega) for omega in options.omega]
    return [*options.users, *own] or list(PAPER_USERS.values())


def _manner(options: argparse.Namespace) -> Manner:
    return Manner(
        rationality=options.rationality,
        myopia=options.myopia,
        mistakes=options.mistakes,
        equal_share=options.equal,
        skip_share=options.skip,
    )


def _settings(options: argparse.Namespace) -> StudySettings:
    behaviours = StudySettings.model_fields["behaviours_per_scenario"].default
    pairs_per_scenario = behaviours * (behaviours - 1) // 2
    chosen = {
        "labels_per_participant": options.labels,
        "retrain_every_labels": options.retrain_every,
        "filter_milestones": tuple(options.milestones),
        "pool_scenarios": options.clip_scenarios or -(-options.labels // pairs_per_scenario),
        "method": options.method,
        "reward_kind": options.reward,
        "strategy": options.strategy,
        "pooled_prior": options.pooled_prior,
        "clip_quality": ClipQuality.QUICK,  # nobody looks at them
    }
    if not options.paper:
        return StudySettings(**chosen)
    chosen["introduction_pairs"] = min(PAPER_PROTOCOL.introduction_pairs, options.labels)
    chosen["evaluation"] = EvaluationSettings(fine_tuning_steps=options.fine_tuning_steps)
    return StudySettings(**{**PAPER_PROTOCOL.model_dump(), **chosen})
