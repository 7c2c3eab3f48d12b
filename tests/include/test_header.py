"""failover.h: each commit in C is one commit to every reader, whichever process is killed; refusals are sentences."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from checkpoint.engines.cooperative.session import open_segment
from checkpoint.errors import CaptureError, SegmentError
from checkpoint.segment.reader import SegmentReader
from tests.include.programs import (
    STRICT,
    STRICT_CC,
    committed_in,
    environment,
    has,
    number_told,
    output,
    program,
)

pytestmark = pytest.mark.compiler

KILLS = int(os.environ.get("FAILOVER_HEADER_KILLS", "40"))
SEED = int(os.environ.get("FAILOVER_SEED", str(random.randrange(1 << 32))))
FOLLOWED, COMPARED = "telling", "telling_compared"


def telling(name: str = FOLLOWED) -> Path:
    flags = () if name == FOLLOWED else ("-DFAILOVER_FOLLOW_MIN=SIZE_MAX",)
    return program(name, "telling.c", flags=("-O2", *STRICT, *flags))


def asks(state: Path, *words: str) -> list[str]:
    return output(program("asks"), state, *words).splitlines()


@contextmanager
def running(path: Path, state: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    started = subprocess.Popen(
        [path, *words], env=environment(state), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )  # fmt: skip
    try:
        yield started
    finally:
        started.kill()
        started.communicate()


def segment_of(pid: int) -> SegmentReader:
    """The segment of a program that is about to commit."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        try:
            reader = open_segment(pid)
        except (CaptureError, SegmentError, OSError):  # it has not made it yet, or not all of it
            time.sleep(0.001)
            continue
        if reader.newest():
            return reader
        reader.close()
        time.sleep(0.001)
    raise AssertionError(f"pid {pid} committed nothing")


CALLS = {
    "failover.h": "failover_commit() < 0",
    "failover_board.h": "fb_open(NULL) == NULL",
    "failover_rtdb.h": "fb_open(NULL) == NULL",
}
"""Header → something that a program does by it."""


# --- Compiling -------------------------------------------------------------------------------------------------------


@pytest.mark.sampled(3)
@pytest.mark.parametrize(("header", "call"), CALLS.items(), ids=CALLS.keys())
@pytest.mark.parametrize("level", ["-O0", "-O2", "-O3"])
@pytest.mark.parametrize(
    ("compiler", "strict"),
    [
        ("gcc", STRICT),
        ("clang", STRICT),
        ("musl-gcc", STRICT),
        ("aarch64-linux-gnu-gcc", STRICT),
        ("g++", STRICT_CC),
        ("clang++", STRICT_CC),
    ],
)
def test_it_compiles_without_a_warning_as_c11_and_as_cxx17(
    compiler: str, strict: tuple[str, ...], level: str, header: str, call: str, tmp_path: Path
) -> None:
    if not has(compiler):
        pytest.skip(f"needs {compiler}, which is not installed here")
    source = tmp_path / ("only.cc" if strict is STRICT_CC else "only.c")
    source.write_text(f'#include "{header}"\nint main(void) {{ return {call}; }}\n')
    command = [compiler, *strict, level, "-Iinclude", "-c", "-o", tmp_path / "only.o", source]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr


def test_included_too_late_in_strict_c_it_says_what_to_do(tmp_path: Path) -> None:
    source = tmp_path / "late.c"
    source.write_text('#include <stdio.h>\n#include "failover.h"\n')
    command = ["gcc", "-std=c11", "-Iinclude", "-fsyntax-only", source]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2])
    assert "include it before all other headers" in done.stderr


@pytest.mark.command("g++")
def test_files_in_c_and_in_cxx_keep_one_state(tmp_path: Path) -> None:
    half = program("faces.o", "faces.c", flags=(*STRICT, "-c"))
    path = program("faces", "faces.cc", str(half), flags=STRICT_CC, compiler="g++")
    assert output(path, tmp_path) == "0 2 2.0 2.0 0.5 0\n"
    assert output(path, tmp_path) == "1 2 3.0 2.0 1.0 0\n"


# --- Commits ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [FOLLOWED, COMPARED])
def test_what_c_commits_the_reader_reads_at_every_instant_of_a_killed_writer(name: str, tmp_path: Path) -> None:
    dice = random.Random(SEED)
    print(f"FAILOVER_SEED={SEED}")
    for _ in range(KILLS):
        with running(telling(name), tmp_path, "-1") as started:
            reader = segment_of(started.pid)
            newest = 0
            until = time.monotonic() + dice.random() * 0.01
            while time.monotonic() < until:
                found = reader.read()
                assert found is not None and found.number >= newest
                number_told(found)
                newest = found.number
            started.kill()
            started.wait()
            found = reader.read()
            assert found is not None and found.number >= newest
            number_told(found)
            reader.close()


def test_only_pages_that_changed_are_read_again(tmp_path: Path) -> None:
    with running(program("asks"), tmp_path, "stay") as started:
        assert started.stdin is not None and started.stdout is not None
        reader = segment_of(started.pid)
        since = reader.newest()
        started.stdin.write("\n")
        started.stdin.flush()
        while not started.stdout.readline().startswith("commit 2"):
            pass
        found = reader.read(since)
        assert found is not None and found.pages.tolist() == [0]
        reader.close()


def test_readers_that_hold_every_bank_cost_a_commit_and_the_next_makes_up_for_it(tmp_path: Path) -> None:
    with running(program("asks"), tmp_path, "stay") as started:
        assert started.stdin is not None and started.stdout is not None
        while not started.stdout.readline().startswith("wait 0"):
            pass
        reader = segment_of(started.pid)
        with reader._held(0), reader._held(1), reader._held(2):
            started.stdin.write("\n")
            started.stdin.flush()
            assert "readers hold all banks" in started.stdout.readline()
        started.stdin.write("\n")
        started.stdin.flush()
        assert started.stdout.readline().split()[:2] == ["commit", "2"]
        found = reader.read()
        assert found is not None and int.from_bytes(found.region(0), "little") == 10
        reader.close()


def test_a_child_does_not_commit_and_does_not_keep_the_locks(tmp_path: Path) -> None:
    lines = asks(tmp_path, "child")
    assert lines[2].startswith("child -1 cannot commit in pid")
    assert lines[3].startswith("commit 2") and lines[4].startswith("close 0")


@pytest.mark.parametrize("word", ["orphan", "late orphan"])
def test_a_child_that_outlives_the_program_does_not_keep_its_state_taken(word: str, tmp_path: Path) -> None:
    with running(program("asks"), tmp_path, word) as started:
        assert started.stdout is not None
        awaited = {"wait", "child"}
        while awaited:
            awaited.discard(started.stdout.readline().split()[0])
        os.kill(started.pid, signal.SIGKILL)
        started.wait()
        assert asks(tmp_path)[:2] == ["open 1 ", "value 8"]


# --- Killed and resumed ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [FOLLOWED, COMPARED])
def test_a_killed_program_resumes_from_a_whole_commit_no_older_than_the_last_waited_one(name: str, tmp_path: Path) -> None:
    dice = random.Random(SEED)
    print(f"FAILOVER_SEED={SEED}")
    known = 0
    for turn in range(KILLS):
        with running(telling(name), tmp_path, "-1", *(["wait"] if turn % 4 else [])) as started:
            assert started.stdout is not None
            lines = []
            while not (lines and lines[-1].startswith("began")):
                lines.append(started.stdout.readline())
                assert lines[-1], "it ended"
            assert int(lines[-1].split()[1]) == known
            if turn % 4 == 1:
                lines.append(started.stdout.readline())
            time.sleep(dice.random() * 0.03)
            started.send_signal(signal.SIGKILL)
            lines += started.communicate()[0].splitlines()
        safe = [int(line.split()[1]) for line in lines if line.startswith("safe ")]
        path = tmp_path / "telling.segment"
        found = committed_in(path) if path.stat().st_size else None
        number = number_told(found) if found else 0
        assert number >= max([known, *safe]), f"turn {turn}, seed {SEED}"
        known = number
    assert known >= KILLS // 4


def test_a_program_that_returns_from_main_has_written_its_newest_commit(tmp_path: Path) -> None:
    assert output(telling(), tmp_path, "1000") == "began 0\n"
    assert output(telling(), tmp_path, "5") == "resumed 1000 2\nbegan 1000\n"
    assert output(telling(), tmp_path) == "resumed 1005 3\nbegan 1005\n"


@pytest.mark.parametrize("compiler", ["clang", "musl-gcc"])
def test_it_runs_by_other_compilers_and_another_libc(compiler: str, tmp_path: Path) -> None:
    if not has(compiler):
        pytest.skip(f"needs {compiler}, which is not installed here")
    path = program(f"telling_{compiler}", "telling.c", flags=("-O2", *STRICT), compiler=compiler)
    assert output(path, tmp_path, "100", "wait").splitlines()[-1] == "safe 100"
    assert output(path, tmp_path) == "resumed 100 2\nbegan 100\n"


@pytest.mark.command("aarch64-linux-gnu-gcc")
@pytest.mark.command("qemu-aarch64")
def test_a_state_moves_between_two_processors(tmp_path: Path) -> None:
    flags = ("-O2", "-static", *STRICT)
    other = program("telling_aarch64", "telling.c", flags=flags, compiler="aarch64-linux-gnu-gcc")
    emulator = Path(shutil.which("qemu-aarch64") or "")
    assert output(emulator, tmp_path, str(other), "30", "wait").splitlines()[-1] == "safe 30"
    assert output(telling(), tmp_path, "30") == "resumed 30 2\nbegan 30\n"
    assert output(emulator, tmp_path, str(other)) == "resumed 60 3\nbegan 60\n"


def test_two_programs_do_not_share_a_state(tmp_path: Path) -> None:
    with running(program("asks"), tmp_path, "stay") as started:
        assert started.stdout is not None
        while not started.stdout.readline().startswith("wait 0"):
            pass
        assert "another process has it" in asks(tmp_path)[0]


# --- What is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("many", "region 'r1024': there are 1024"),
        ("none", "no region is registered"),
        ("overlap", "region 'inside': it overlaps with 'value'"),
        ("twice", "region 'value': another one has that name"),
        ("nameless", "a name has 1 to 200 bytes"),
        ("latin", "region 2, of 8192 bytes: its name is no UTF-8"),
        ("surrogate", "region 2, of 8192 bytes: its name is no UTF-8"),
    ],
)
def test_what_cannot_be_kept_is_refused_by_its_name(word: str, sentence: str, tmp_path: Path) -> None:
    first, second = asks(tmp_path, word)[:2]
    assert first.startswith("open -") and sentence in first
    assert second == "commit -22 cannot commit: no state is open; call failover_open() first"


def test_a_name_in_any_script_is_read_by_others(tmp_path: Path) -> None:
    asks(tmp_path, "umlaut")
    found = committed_in(tmp_path / "asks.segment")
    assert found is not None and [region.name for region in found.layout.regions] == ["value", "grün 🤖"]


def test_a_commit_too_early_and_a_region_too_late_are_refused(tmp_path: Path) -> None:
    assert asks(tmp_path, "early")[0].startswith("commit -22 cannot commit: no state is open")
    assert "register regions before failover_open()" in asks(tmp_path, "late")[3]


def test_regions_come_and_go_and_the_program_is_told(tmp_path: Path) -> None:
    asks(tmp_path, "more")
    assert asks(tmp_path)[:3] == ["open 1 ", "value 8", "1 regions of the stored state are not kept any more"]
    assert asks(tmp_path, "more")[:3] == ["open 1 ", "value 9", "region 'other' is new and begins as it is"]


def test_a_region_of_another_size_is_refused_and_nothing_is_lost(tmp_path: Path) -> None:
    asks(tmp_path, "bytes")
    before = (tmp_path / "asks.segment").read_bytes()
    assert "region 'bytes' has 8192 bytes there and 100 here" in asks(tmp_path, "size")[0]
    assert (tmp_path / "asks.segment").read_bytes() == before


def test_a_segment_of_another_version_is_refused_and_left_alone(tmp_path: Path) -> None:
    asks(tmp_path)
    path = tmp_path / "asks.segment"
    content = bytearray(path.read_bytes())
    content[8] = 2
    path.write_bytes(content)
    assert "it is of version 2 with pages of 4096 bytes, this header reads version 1" in asks(tmp_path)[0]
    assert path.read_bytes() == content


def test_a_damaged_commit_is_passed_over_and_said_or_refused(tmp_path: Path) -> None:
    """One bit anywhere in the newest commit: the one before is taken, with a note; without one the program is refused."""
    asks(tmp_path)
    path = tmp_path / "asks.segment"
    content = bytearray(path.read_bytes())
    content[-3 * 4096] ^= 1
    path.write_bytes(content)
    assert "it is damaged, and holds no whole commit" in asks(tmp_path)[0]
    path.unlink()
    output(telling(), tmp_path, "2", "wait")
    path = tmp_path / "telling.segment"
    content = bytearray(path.read_bytes())
    content[512 + 64 * content[256] + 9] ^= 1
    path.write_bytes(content)
    assert output(telling(), tmp_path) == "resumed 1 2\nthe newest commit was damaged; commit 1 took its place\nbegan 1\n"


def test_whatever_the_file_holds_the_program_reads_it_or_refuses_it(tmp_path: Path) -> None:
    dice = random.Random(SEED)
    print(f"FAILOVER_SEED={SEED}")
    asks(tmp_path)
    path = tmp_path / "asks.segment"
    whole = path.read_bytes()
    for _ in range(60):
        content = bytearray(whole)
        for _ in range(dice.randrange(1, 4)):
            start, size = dice.choice([(0, 56), (256, 8), (512, 192), (4096, 256)])
            content[start + dice.randrange(size)] = dice.choice([0, 255, dice.randrange(256)])
        path.write_bytes(content[: dice.choice([len(content), dice.randrange(len(content) + 1)])])
        first, second, *_ = asks(tmp_path)
        assert first.startswith(("open 1", "open -")) or path.stat().st_size == 0 or first == "open 0 ", first
        assert not first.startswith("open 1") or second == "value 8" or "segment" in second, (first, second)


# --- Tools that watch ------------------------------------------------------------------------------------------------


@pytest.mark.command("valgrind")
def test_valgrind_finds_nothing(tmp_path: Path) -> None:
    watched = ["valgrind", "-q", "--error-exitcode=9", "--leak-check=full", "--errors-for-leak-kinds=definite"]
    for _ in range(2):
        done = subprocess.run(
            [*watched, telling(COMPARED), "20", "wait"],
            env=environment(tmp_path),
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("kind", ["thread", "address,undefined"])
def test_sanitizers_find_nothing(kind: str, tmp_path: Path) -> None:
    name = "telling_" + kind.replace(",", "_")
    try:
        path = program(name, "telling.c", flags=("-O1", "-std=c11", f"-fsanitize={kind}"))
    except AssertionError as error:
        pytest.skip(f"needs a compiler with -fsanitize={kind}: {error}")
    for begun in (0, 300):
        found = output(path, tmp_path, "300", TSAN_OPTIONS="halt_on_error=1")
        assert found.endswith(f"began {begun}\n"), found
