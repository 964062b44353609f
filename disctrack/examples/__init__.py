"""Diagnoses of measurements that others made and published; each module runs by itself with `python -m`."""

import os

# before numpy is loaded, as in `disctrack.cli`: the small matrices are slower on several threads
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
