"""That some participants are programs, said in files that leave the studio."""

from collections.abc import Mapping


def scripted_in_words(scripted: Mapping[str, str]) -> str:
    """A paragraph for whoever might take them for people; nothing when all are."""
    if not scripted:
        return ""
    played = ", ".join(f"{code} ({user})" for code, user in scripted.items())
    return (
        f"\n**These participants are not people: {played}.** A program answered and rated for them"
        " (`scripted_as` in the table `participants`).\n"
    )
