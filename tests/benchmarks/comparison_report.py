"""The page of a comparison, from the CSV files beside it: nothing is measured anew.

    python -m tests.benchmarks.comparison_report docs/results/all_methods

``python -m worker benchmark`` writes the same page when its cells are at hand.
"""

import argparse
from pathlib import Path

from worker.analysis.comparison import comparison_page

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    (folder / "table1.md").write_text(comparison_page.page(folder))
