"""The card of an exported dataset: what Hugging Face's datasets reads to know its parts, and what people read."""

from collections.abc import Sequence

from sqlalchemy.orm import Session

from app.domain.studies import Study
from app.services.evaluation import unblinding
from app.services.exports import export_formats, whose_rows
from worker.jobs.publishing.scripted_words import scripted_in_words


def card(session: Session, study: Study, tables: Sequence[str], with_preferences: bool) -> str:
    """README.md of the dataset, with ``configs`` so that load_dataset opens it."""
    provenance = export_formats.provenance_of(session, study)
    scripted = {each.code: each.scripted_as for each in whose_rows.everybody(session, study) if each.scripted_as}
    parts = {"default": "data/*/*.parquet"}
    parts |= {"preferences": "preferences/*.parquet"} if with_preferences else {}
    parts |= {table: f"tables/{table}.parquet" for table in tables}
    configs = "\n".join(f"- config_name: {name}\n  data_files: {files}" for name, files in parts.items())
    return _CARD.format(
        configs=configs,
        name=" ".join(study.name.split()),
        slug=study.slug,
        version=provenance.software_version,
        moment=provenance.exported_at.isoformat(timespec="seconds"),
        lock=provenance.lock_hash,
        blinded="Letters stand for methods." if unblinding.is_blinded(study) else "It is not blinded (any more).",
        scripted=scripted_in_words(scripted),
    )


_CARD = """\
---
tags:
- LeRobot
- robotics
- preferences
task_categories:
- robotics
configs:
{configs}
---

# {name} ({slug})

Exported {moment} by PbARL Studio {version}. Lock hash of settings and plan: {lock}. {blinded}
{scripted}
**Before you publish it**: films can show people, the tables have what participants wrote and, where they came through a
recruitment panel, their ids there. Choose a licence, and leave out what the consent does not cover.

| part | what |
|---|---|
| `default` | the frames of every clip as a LeRobotDataset (v3): state, action, signals; films in `videos/` |
| `preferences` | who preferred which of two episodes; `target` is P(right preferred), empty for "can't tell" |
| others | the tables of the study, explained by its data dictionary |

An episode is what one clip shows. `meta/episodes` has its scenario (episodes of one scenario may be compared), the way
of doing it, and `clip`: the film as participants saw it is `clips/<clip>.mp4`, in `videos/` it has one picture a step.

    from datasets import load_dataset
    preferences = load_dataset("this/folder", "preferences", split="train")

    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    episodes = LeRobotDataset("lab/{slug}", root="this/folder")
"""
