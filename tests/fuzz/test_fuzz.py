"""Hostile bytes at every decoder, a counted number; and that the fuzzing run finds what is wrong, and plays it again."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from random import Random

import pytest

from tests.fuzz import targets
from tests.fuzz.__main__ import main
from tests.fuzz.mutation import SIZE_MAX, mutated
from tests.fuzz.reached import ROOT, Reached
from tests.fuzz.target import TARGETS

CASES = os.environ.get("FAILOVER_FUZZ_CASES", "120")
SEED = os.environ.get("FAILOVER_FUZZ_SEED", "1")
"""Always the same cases: a change that fails here is wrong, and not unlucky. ``./run fuzz`` draws others."""


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_every_decoder_answers_hostile_bytes_with_a_value_or_a_sentence(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.fuzz", "--cases", CASES, "--seed", SEED, "--findings", str(tmp_path)]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    targets.load()
    left_out = [line.partition(":")[0] for line in ran.stdout.splitlines() if ": left out: " in line]
    assert len([line for line in ran.stdout.splitlines() if f" {CASES} cases, " in line]) == len(TARGETS) - len(left_out)


WRONG = """
import os, sys, time
from tests.fuzz.__main__ import main
from tests.fuzz.target import TARGETS, Decoder, target
from failover.errors import FailoverError

def refused(content):
    raise FailoverError("no")

def fails(content):
    return {}[len(content)] if len(content) != 4 else 0

def eats(content):
    return len(bytes(400 << 20)) if content != b"seed" else 0

def loops(content):
    while content != b"seed":
        pass

def dies(content):
    if content != b"seed":
        os.abort()

def silent(content):
    if content != b"seed":
        raise FailoverError("")

def sound(content):
    return refused(content) if content != b"seed" else 0

for one in (fails, eats, loops, dies, silent, sound, refused):
    def made(one=one):
        return Decoder([b"seed"], one)
    made.__name__ = one.__name__
    target("nobody's")(made)
sys.exit(main(sys.argv[1:]))
"""
FOUND = {
    "fails": "KeyError",
    "eats": "MemoryError",
    "loops": "more than 2 s of processor time",
    "dies": "the process died by SIGABRT",
    "silent": "FailoverError",
    "refused": "the target failed before its first case",
}


@pytest.mark.timeout(300)
def test_each_wrong_outcome_is_found_written_and_played_again(tmp_path: Path) -> None:
    def ran(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "-c", WRONG, *arguments], cwd=ROOT, capture_output=True, text=True)

    whole = ran("--cases", "1", "--seed", "5", "--findings", str(tmp_path))
    assert whole.returncode == 1 and "each of these plays one again" in whole.stderr
    kept = {path: json.loads(path.read_text()) for path in sorted(tmp_path.iterdir())}
    assert {one["target"] for one in kept.values()} == FOUND.keys()
    assert all(one["what"].startswith(FOUND[one["target"]]) for one in kept.values())
    assert all(one["seed"] == 5 and one["again"] == f"./run fuzz --play {path}" for path, one in kept.items())
    paths = {one["target"]: str(path) for path, one in kept.items()}
    again = ran("--play", paths["fails"])
    assert again.returncode == 1 and "KeyError" in again.stderr
    assert ran("--play", paths["dies"]).returncode == -signal.SIGABRT


def test_the_same_seed_makes_the_same_cases_within_the_limit() -> None:
    seeds = [
        b'{"a": [1, {"b": "text"}], "n": 5}',
        b"\x82\xa1a\x93\x01\x02\xa1x\xa1b\xc4\x02ab",
        b"name = 3\n[table]\nx = [1, 2]\n",
        b"",
    ]
    for form in ("bytes", "text", "json", "msgpack"):
        first, again = (
            [mutated(seeds[number % 4], Random(f"1 {number}"), form, seeds) for number in range(400)]  # type: ignore[arg-type]
            for _ in range(2)
        )
        assert first == again and len(set(first)) > 200
        assert max(map(len, first)) <= SIZE_MAX


def test_a_new_line_is_told_once_also_where_the_call_raises() -> None:
    from failover.core.naming import names
    from failover.errors import NameFormatError

    reached = Reached()

    def call(content: bytes) -> object:
        return names.parse(content.decode())

    assert reached.call(call, b"lab/robot1")
    assert not reached.call(call, b"lab/robot2")
    before = reached.count
    with pytest.raises(NameFormatError):
        reached.call(call, b"lab/../robot1")
    assert reached.count > before
    assert reached.call(call, b"10.0.0.1:80")


def test_a_wrong_command_is_refused_in_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for argv, said in (
        ([], "say how many MINUTES"),
        (["1", "none-such"], "no target none-such"),
        (["--play", "/none"], "cannot read"),
    ):
        assert main(argv) == 2
        assert said in capsys.readouterr().err
