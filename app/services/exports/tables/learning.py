"""What was learned from the answers, and what it changes on unseen scenarios."""

from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.models import Bundle, Model, ModelKind
from app.domain.protocol import EvaluatedMethod
from app.domain.studies import Study
from app.services.evaluation import unblinding
from app.services.exports.export_formats import Column, Table
from app.services.exports.paging import KeyedRows, Window
from app.services.exports.tables.columns import PARTICIPANT, SHA256, B, I, J, N, T, W, words
from app.services.exports.whose_rows import present
from app.services.runs import model_metrics


def _models(session: Session, study: Study, window: Window) -> KeyedRows:
    """While the study is blinded, without the hashes of methods: those are files of letters as well."""
    blinded = unblinding.is_blinded(study)
    for person, wanted in present(session, study, window):
        theirs = select(Model).where(Model.participant_id == person.id, wanted.beyond(Model.id), wanted.known(Model))
        for each in session.scalars(theirs.order_by(Model.id)):
            yield (
                (person.number, each.id),
                (
                    person.code,
                    each.kind,
                    each.label_count,
                    each.label_hash,
                    each.seed,
                    None if blinded and each.kind == ModelKind.METHOD else each.artefact_sha256,
                    each.created_at,
                    _while_training(each),
                ),
            )


def _while_training(model: Model) -> dict[str, Any]:
    """Methods are measured after they have been kept: that is in _evaluations(), for here no row changes."""
    if model.kind != ModelKind.METHOD:
        return model.metrics
    return {name: value for name, value in model.metrics.items() if name not in ("evaluation", "seconds")}


MODELS = Table(
    "models",
    "Every model that was trained for a participant.",
    (
        PARTICIPANT,
        Column("kind", T, "Kind of model.", allowed=words(ModelKind)),
        Column(
            "label_count",
            I,
            "Answers given by then, including excluded ones and those without a preference.",
        ),
        Column("label_hash", T, "Hash of these answers.", allowed=SHA256),
        Column("seed", I, "Seed of the training."),
        Column("artefact_sha256", T, "The stored file; empty for methods while the study is blinded.", allowed=SHA256),
        Column("created_at", W, "When it was ready."),
        Column("metrics", J, "What was measured while training."),
    ),
    _models,
    (Model,),
    grows_by=Model,
)


_MEASURED = (ModelKind.FILTER, ModelKind.METHOD)


def _evaluations(session: Session, study: Study, window: Window) -> KeyedRows:
    """Of filters and of the methods that they are compared with, by name: letters say nothing of these numbers."""
    for person, wanted in present(session, study, window):
        rows = session.execute(
            select(Model, Bundle)
            .outerjoin(Bundle, Bundle.model_id == Model.id)
            .where(Model.participant_id == person.id, Model.kind.in_(_MEASURED), wanted.known(Model))
            .order_by(Model.label_count, Model.id)
        ).all()
        newest = {_method_of(model): model.id for model, _ in rows}
        for model, bundle in rows:
            measured = model_metrics.filter_version(model, bundle)
            named = [("success", measured.success), ("preference", measured.preference)]
            named += [(cost.symbol, cost) for cost in measured.costs]
            for number, (name, change) in enumerate(named):
                key = model.label_count, model.id, number
                if change is not None and key > wanted.after:
                    yield (
                        (person.number, *key),
                        (
                            person.code,
                            _method_of(model),
                            measured.label_count,
                            newest[_method_of(model)] == model.id,
                            measured.bundle_version,
                            measured.scenarios,
                            name,
                            change.reference,
                            change.filtered,
                            change.delta,
                            change.low,
                            change.high,
                        ),
                    )


def _method_of(model: Model) -> str:
    return EvaluatedMethod.PBARL.value if model.kind == ModelKind.FILTER else str(model.metrics.get("method"))


EVALUATIONS = Table(
    "evaluations",
    "What each filter, and each method it is compared with, changes on unseen simulated scenarios, against the "
    "reference policy; one row per measure.",
    (
        PARTICIPANT,
        Column(
            "method",
            T,
            "pbarl: the participant's own filter.",
            allowed=words(each for each in EvaluatedMethod if each is not EvaluatedMethod.REFERENCE),
        ),
        Column("label_count", I, "Answers it has learned from, or the participant had given."),
        Column("newest", B, "Whether it is the participant's newest of the method."),
        Column("bundle_version", I, "Version of the published bundle, if there is one."),
        Column("scenarios", I, "Unseen scenarios it was measured on."),
        Column(
            "measure",
            T,
            "success: share of scenarios. preference: learned return, in standard deviations of the reference's. "
            "C_*: the paper's costs, summed per episode.",
            allowed="success, preference, C_d, C_v, C_f, C_hf, C_fd, C_fdv",
        ),
        Column("reference", N, "Mean with the reference policy; empty for preference."),
        Column("filtered", N, "Mean with the filter; empty for preference."),
        Column("delta", N, "Mean difference, filtered minus reference, paired by scenario."),
        Column("low", N, "Lower end of the 95 % interval of the difference."),
        Column("high", N, "Upper end."),
    ),
    _evaluations,
    (Model,),
)
