"""What the benchmark of simulated robots says when what it measures has ended."""

from __future__ import annotations

import subprocess

import psutil
import pytest

from benchmarks import simulated
from benchmarks.running import BenchmarkError


def test_a_page_that_has_ended_is_said_in_a_sentence() -> None:
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE) as program:
        page = psutil.Process(program.pid)
        assert simulated._memory_mb(page) > 0 and simulated._processor_s(page) >= 0
        program.kill()
        while page.status() != psutil.STATUS_ZOMBIE:
            pass
        with pytest.raises(BenchmarkError, match="has ended"):
            simulated._memory_mb(page)
    with pytest.raises(BenchmarkError, match="has ended"):
        simulated._processor_s(page)


def test_a_simulation_that_failed_is_said_in_a_sentence() -> None:
    assert simulated._told('{"missed": 1}', 1) == {"missed": 1}
    with pytest.raises(BenchmarkError, match="failed with status 2"):
        simulated._told("", 2)
