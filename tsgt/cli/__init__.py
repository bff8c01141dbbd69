"""The command line: thin commands over the packages below, and the only place that knows click."""

import os

# Before numpy is loaded: matrices are small here, and a second thread costs more than it computes (twice the time of
# `tsgt evaluate` on two cores). Who knows better has set it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
