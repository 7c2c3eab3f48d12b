"""A test that hangs, kills its worker or is reported slowly fails alone, and the run ends as usual (`tests.runner`)."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

CONFTEST = """
import time
import pytest

pytest_plugins = ["tests.runner"]

@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    report = yield
    if "told_slowly" in item.name and call.when == "call":
        time.sleep(4)
    if "internal" in item.name and call.when == "call":
        raise RuntimeError("a hook is wrong")
    return report
"""

KILLS = """
import os, signal

def test_before(): pass
def test_kills_its_worker(): os.kill(os.getpid(), signal.SIGKILL)
def test_after(): pass
"""

FILES = {
    "test_kills.py": KILLS,
    "test_kills_too.py": KILLS,
    "test_hangs.py": """
import signal, time
import pytest

@pytest.mark.timeout(2)
def test_hangs(): time.sleep(1000)

@pytest.mark.timeout(2)
def test_hangs_for_good():
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
    time.sleep(1000)

def test_after(): pass
""",
    "test_reports.py": """
import pytest

@pytest.mark.timeout(2)
def test_is_told_slowly(): pass

def test_internal(): pass
def test_after(): pass
""",
    "test_well.py": "def test_is_well(): pass",
}
FAILED = [
    "test_hangs.py::test_hangs",
    "test_hangs.py::test_hangs_for_good",
    "test_kills.py::test_kills_its_worker",
    "test_kills_too.py::test_kills_its_worker",
    "test_reports.py::test_internal",
]
PASSED = 8


def run_pytest(directory: Path, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Have another pytest run the tests of a directory, with these variables in its environment."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    environment["PYTEST_DEBUG_TEMPROOT"] = str(directory)  # ours is open to other users in some tests; pytest closes it
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-q", *words]
    environment |= {"PYTHONPATH": str(ROOT)} | variables
    return subprocess.run(command, cwd=directory, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_run_ends_as_usual_whatever_its_tests_do(tmp_path: Path) -> None:
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "conftest.py").write_text(CONFTEST)
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    ran = run_pytest(tmp_path, "-n", "2", "-rf")
    said = ran.stdout + ran.stderr
    assert ran.returncode == pytest.ExitCode.TESTS_FAILED, said
    assert "INTERNALERROR" not in said
    failed = sorted(line.split()[1] for line in ran.stdout.splitlines() if line.startswith("FAILED "))
    assert failed == FAILED, said
    assert f"{len(FAILED)} failed, {PASSED} passed" in ran.stdout, said
    assert "in test_hangs_for_good" in said, "the stacks of a test that nothing but its worker's end could end"
    assert "a hook is wrong" in said


@pytest.mark.parametrize(
    ("cases", "words", "count"), [("", [], 2), ("all", [], 6), ("", ["test_many.py::test_many"], 6), ("", ["-k", "many"], 6)]
)
def test_of_a_test_with_many_cases_a_run_takes_some_unless_all_are_asked_for(
    cases: str, words: list[str], count: int, tmp_path: Path
) -> None:
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = sampled(n): one case in n\n")
    (tmp_path / "conftest.py").write_text('pytest_plugins = ["tests.runner"]\n')
    many = '@pytest.mark.sampled(3)\n@pytest.mark.parametrize("a", [1, 2])\n@pytest.mark.parametrize("b", [1, 2, 3])\n'
    (tmp_path / "test_many.py").write_text(f"import pytest\n\n{many}def test_many(a, b): pass\n")
    ran = run_pytest(tmp_path, "--collect-only", *words, FAILOVER_CASES=cases)
    assert ran.stdout.count("::test_many[") == count, ran.stdout + ran.stderr
