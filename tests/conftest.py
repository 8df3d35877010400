"""One thread a process: sums then do not depend on the machine, and tests run as processes."""

import os

for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

import torch  # noqa: E402  (reads the number of threads when it is imported)

torch.set_num_threads(1)
