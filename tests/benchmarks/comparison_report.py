"""The page and the pictures of a comparison, from the CSV files beside them: nothing is measured anew.

    python -m tests.benchmarks.comparison_report docs/results/all_methods

``python -m worker benchmark`` writes the same when its cells are at hand.
"""

import argparse
from pathlib import Path

from worker.analysis.comparison import comparison_page, pareto, table_files
from worker.ml.methods.registry import METHODS

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    (folder / "table1.md").write_text(comparison_page.page(folder))
    for name, picture in pareto.pictures(table_files.read(folder)[0]["table1"], list(METHODS)):
        (folder / name).write_text(picture)
