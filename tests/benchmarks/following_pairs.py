"""Whether pairs made for the person pay: the true preference that their mode gains, with and without such pairs.

    python -m tests.benchmarks.following_pairs

Scripted users (5 % mistakes, 10 % "equal") answer pairs of a pool as large as a study's, chosen by entropy with the
usual random share. Beside it the same with 30 % of the pairs made for them, from the tenth answer on: the newest
model's mode and a variation of it, each really simulated. After 25, 50 and 100 answers the search of modes picks the
user's mode; its gain of the true preference, in % of what the user minds and likes under the reference policy, is what
the response surface predicts. The pool is kept under data/, every finished chain in --output: repeat the command to go
on.
"""

from tests.benchmarks import answering
from tests.benchmarks.answering import Variant

TITLE = "# Whether pairs that follow the person pay"
SHARES = {"0.0": Variant(), "0.3": Variant(following_share=0.3)}


def main() -> None:
    """See the module."""
    options = answering.parser(__doc__, "following_pairs", seeds=1).parse_args()
    answering.run(options, TITLE, "share", SHARES)


if __name__ == "__main__":
    main()
