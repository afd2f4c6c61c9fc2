"""Whether it pays to ask for hints such as "slower near me": by how much more people like the modes they get.

    python -m tests.benchmarks.hints

About an hour of one core. Finished chains are kept in the table of results; repeat the command to go on.
"""

from tests.benchmarks import answering
from tests.benchmarks.answering import Variant

TITLE = "# Whether it pays to ask for hints"
HINTS = {
    "none": Variant(),
    "true": Variant(hints=1.0),
    "a quarter wrong": Variant(hints=0.75),
    "at random": Variant(hints=0.0),
    "true, fourfold": Variant(hints=1.0, hint_weight=4),
    "at random, fourfold": Variant(hints=0.0, hint_weight=4),
}


def main() -> None:
    """See the module."""
    options = answering.parser(__doc__, "hints").parse_args()
    answering.run(options, TITLE, "hints", HINTS)


if __name__ == "__main__":
    main()
