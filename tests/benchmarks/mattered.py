"""Whether it pays to ask what made the difference: the true preference that somebody's mode gains, asked and not.

    python -m tests.benchmarks.mattered

Scripted users (5 % mistakes, 10 % "equal") answer pairs of a pool as large as a study's, chosen by entropy with the
usual random share. Beside it they name, with every answer for one side, a quality: in 7 of 10 the one that speaks most
for that side, else any ("seldom wrong"), or always any ("at random"). After 25, 50 and 100 answers the search of modes
picks the user's mode; its gain of the true preference, in % of what the user minds and likes under the reference
policy, is what the response surface predicts. The pool is kept under data/, every finished chain in --output: repeat
the command to go on.
"""

from tests.benchmarks import answering
from tests.benchmarks.answering import Variant

TITLE = "# Whether it pays to ask what made the difference"
NAMING = {"nothing": Variant(), "seldom wrong": Variant(names=0.7), "at random": Variant(names=0.0)}


def main() -> None:
    """See the module."""
    options = answering.parser(__doc__, "mattered").parse_args()
    answering.run(options, TITLE, "named", NAMING)


if __name__ == "__main__":
    main()
