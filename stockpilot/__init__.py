"""The command line over both sides: missions, runs, scores, reports. The only code that knows companion and simbridge both."""

import os

# Before numpy is imported: sums that are spread over threads end in other last bits, and a replay would differ from its flight.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
