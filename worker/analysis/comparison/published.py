"""Table I of the paper (Wang et al., PbARL): success in % and mean preference return on 500 unseen scenarios.

Copied from the LaTeX source of the paper, table "tab:results". The returns are of an unnormalised learned reward whose
zero and unit are arbitrary, so only signs and order can be compared with ours (docs/method.md, erratum 7).
"""

from collections.abc import Mapping

TABLE_1: Mapping[tuple[str, str], Mapping[str, tuple[float, float]]] = {
    ("feeding", "neutral"): {
        "reference": (92, 11.2),
        "pbrl_hri": (41, 12.1),
        "prefft": (73, 45.6),
        "pbarl_n1": (80, 44.8),
        "pbarl_n20": (84, 53.2),
        "pbarl": (88, 50.7),
    },
    ("feeding", "cautious"): {
        "reference": (90, 12.3),
        "pbrl_hri": (42, 12.8),
        "prefft": (69, 51.2),
        "pbarl_n1": (79, 48.1),
        "pbarl_n20": (83, 52.1),
        "pbarl": (83, 54.7),
    },
    ("feeding", "impatient"): {
        "reference": (89, 15.6),
        "pbrl_hri": (39, 18.9),
        "prefft": (75, 44.8),
        "pbarl_n1": (78, 46.2),
        "pbarl_n20": (85, 55.7),
        "pbarl": (84, 56.1),
    },
    ("drinking", "neutral"): {
        "reference": (79, 14.6),
        "pbrl_hri": (29, 16.3),
        "prefft": (63, 41.2),
        "pbarl": (74, 51.8),
    },
    ("drinking", "cautious"): {
        "reference": (78, 16.1),
        "pbrl_hri": (35, 17.5),
        "prefft": (61, 40.7),
        "pbarl": (70, 48.6),
    },
    ("drinking", "impatient"): {
        "reference": (81, 14.2),
        "pbrl_hri": (30, 14.7),
        "prefft": (70, 36.9),
        "pbarl": (79, 51.1),
    },
    ("scratching", "neutral"): {
        "reference": (71, 10.9),
        "pbrl_hri": (23, 13.2),
        "prefft": (55, 43.3),
        "pbarl": (67, 40.6),
    },
    ("scratching", "cautious"): {
        "reference": (74, 11.8),
        "pbrl_hri": (21, 14.5),
        "prefft": (56, 46.3),
        "pbarl": (69, 51.6),
    },
    ("scratching", "impatient"): {
        "reference": (74, 10.2),
        "pbrl_hri": (24, 13.9),
        "prefft": (52, 47.5),
        "pbarl": (70, 51.1),
    },
}
"""By task and user, then method: (success %, return). Its "PbARL" has n = 10: our pbarl_printed is that, as printed."""


def published(task: str, user: str, method: str) -> tuple[float, float] | None:
    """(success %, return) of the paper, or None. Both pbarl and pbarl_printed stand beside the paper's PbARL."""
    name = "pbarl" if method == "pbarl_printed" else method
    return TABLE_1.get((task, user), {}).get(name)
