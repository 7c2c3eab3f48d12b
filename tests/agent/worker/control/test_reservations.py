"""The file in which a robot keeps its reservations. What robots tell each other: ``tests/e2e/test_reservations.py``."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from agent.errors import AgentError, RefusedError
from agent.system import clock
from agent.worker.control.reservations import FILE, Kept, Reservations
from agent.worker.network.remote_orders import Errands

MAPPER = "/lab/r1/mapper"
ANNA, BEN = 60_001, 60_002


async def nobody() -> list[str]:
    return []


async def no_right(_path: str) -> str:
    return "you have no right"


def no_errands() -> Errands:
    raise AssertionError("there is no robot that could be asked")


def at(place: Path) -> Reservations:
    """As the next life of an agent finds them."""
    return Reservations(place, no_errands, nobody)


@pytest.fixture
def reserved(tmp_path: Path) -> Path:
    """Where anna's reservation is kept."""
    told = asyncio.run(at(tmp_path).begin("lab/r1", ANNA, 600_000, "new wheels"))
    assert (told["path"], told["left_ms"], told["untold"]) == ("/lab/r1", 600_000, [])
    return tmp_path


def test_it_outlives_an_agent_and_so_does_its_end(reserved: Path) -> None:
    assert at(reserved).refusal(BEN, MAPPER).startswith(f"/lab/r1 is reserved by uid {ANNA} until ")
    assert at(reserved).refusal(ANNA, MAPPER) == "" and at(reserved).refusal(BEN, "/lab/r2") == ""
    asyncio.run(at(reserved).end(MAPPER, ANNA, False, no_right))
    assert at(reserved).refusal(BEN, MAPPER) == ""


def test_after_a_reboot_its_instants_mean_nothing(reserved: Path) -> None:
    kept = msgspec.msgpack.decode((reserved / FILE).read_bytes(), type=Kept)
    assert kept.boot_id == clock.kernel_boot()
    (reserved / FILE).write_bytes(msgspec.msgpack.encode(msgspec.structs.replace(kept, boot_id="another")))
    assert at(reserved).refusal(BEN, MAPPER) == ""


@pytest.mark.parametrize("spoil", [lambda content: content[:-3], lambda _: b"", lambda _: b"\xff" * 99])
def test_a_file_that_is_none_is_no_reservation(reserved: Path, spoil: Callable[[bytes], bytes]) -> None:
    (reserved / FILE).write_bytes(spoil((reserved / FILE).read_bytes()))
    assert at(reserved).refusal(BEN, MAPPER) == ""


def test_who_may_end_it(reserved: Path) -> None:
    async def may(_path: str) -> str:
        return ""

    for breaks, may_break, said in ((False, may, "with --break root may"), (True, no_right, "you have no right")):
        with pytest.raises(RefusedError, match=said):
            asyncio.run(at(reserved).end(MAPPER, BEN, breaks, may_break))
    told = asyncio.run(at(reserved).end(MAPPER, BEN, True, may))
    assert told["sentence"] == f"/lab/r1 is free again: uid {BEN} has broken the reservation of uid {ANNA}"
    with pytest.raises(RefusedError, match="is not reserved"):
        asyncio.run(at(reserved).end(MAPPER, BEN, True, may))


@pytest.mark.parametrize("path", ["/lab/../x", "", "/", "/lab//x", "x" * 300, "/lab/r1/" + 60 * "\ufdfa"])
def test_what_is_no_path_cannot_be_reserved(tmp_path: Path, path: str) -> None:
    with pytest.raises(RefusedError, match="is no path"):
        asyncio.run(at(tmp_path).begin(path, ANNA, 1_000, ""))


def test_a_main_loop_that_does_not_answer_in_time_is_asked_again(reserved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agent.worker.control.reservations.TELL_AGAIN_S", 0)
    asked: list[int] = []

    async def late() -> list[str]:
        asked.append(len(asked))
        if len(asked) == 3:
            raise EOFError("seen often enough")
        raise AgentError("the main loop did not answer")

    with pytest.raises(EOFError):
        asyncio.run(Reservations(reserved, no_errands, late).tell_again())
    assert asked == [0, 1, 2]
