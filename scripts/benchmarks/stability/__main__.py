"""Take the errors of a report into the table of what the cases reached: `python -m ... REPORT.json`."""

import sys
from pathlib import Path

from scripts.benchmarks.stability.reached import TABLE, record

for report in sys.argv[1:]:
    print(f"{record(Path(report))} cases of {report}: {TABLE}")
