"""The solvers' hold on BLAS threads."""

import ast
import os
import subprocess
import sys

import pytest

pytest.importorskip("threadpoolctl")

CODE = """
from drocap_ros.reconstruction.common.engine import blas_threads
with blas_threads(1):
    import scipy.linalg
    import threadpoolctl
    print([pool["num_threads"] for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"])
"""


def test_a_library_that_is_loaded_later_is_held_too():
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2"}
    environment.pop("OMP_NUM_THREADS", None)
    run = subprocess.run([sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, check=True)
    threads = ast.literal_eval(run.stdout)
    assert threads
    assert set(threads) == {1}
