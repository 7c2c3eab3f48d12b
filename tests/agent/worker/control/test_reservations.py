"""The file in which a robot keeps its reservations. What robots tell each other: ``tests/e2e/test_reservations.py``."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

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


def test_root_is_told_how_to_break_it_and_breaks_all_at_and_below_a_path_at_once(reserved: Path) -> None:
    async def may(_path: str) -> str:
        return ""

    asyncio.run(at(reserved).begin("/lab/r2", BEN, 600_000, ""))
    refusal = at(reserved).refusal(0, MAPPER)
    assert refusal.endswith("or wait until then, or end it with failover unreserve /lab/r1 --break")
    assert "--break" not in at(reserved).refusal(BEN, MAPPER)
    told = asyncio.run(at(reserved).end("/lab", 0, True, may))
    who = f"root has broken the reservations of uid {ANNA}, uid {BEN}"
    assert told["sentence"] == f"/lab/r1, /lab/r2 are free again: {who}"
    assert at(reserved).refusal(0, MAPPER) == at(reserved).refusal(0, "/lab/r2") == ""


def test_the_deepest_of_ones_own_is_ended(reserved: Path) -> None:
    asyncio.run(at(reserved).begin(MAPPER, ANNA, 600_000, ""))
    assert asyncio.run(at(reserved).end(MAPPER, ANNA, False, no_right))["path"] == MAPPER
    assert at(reserved).refusal(BEN, MAPPER).startswith("/lab/r1 is reserved")


class Way:
    """Between two robots: each message takes a few turns of the event loop, and answers do, too."""

    def __init__(self, turns: int) -> None:
        self.turns = turns
        self.there: dict[str, Reservations] = {}

    def errands(self) -> Errands:
        return cast(Errands, self)

    async def send(self, peer: str, _verb: str, arguments: dict[str, Any], patience_s: float) -> dict[str, Any]:
        assert patience_s > 0
        await self._travel()
        answer = await self.there[peer].hear(arguments, 0)
        await self._travel()
        return answer

    async def _travel(self) -> None:
        for _ in range(self.turns):
            await asyncio.sleep(0)


@pytest.mark.parametrize("turns", [(0, 0), (50, 0), (0, 50), (9, 9)])
def test_of_two_at_once_at_two_robots_one_is_refused_and_both_robots_agree(tmp_path: Path, turns: tuple[int, int]) -> None:
    ways = [Way(each) for each in turns]

    def robot(number: int) -> Reservations:
        async def other() -> list[str]:
            return [f"r{1 - number}"]

        place = tmp_path / str(number)
        place.mkdir()
        return Reservations(place, ways[number].errands, other)

    async def both() -> None:
        first, second = robot(0), robot(1)
        ways[0].there["r1"], ways[1].there["r0"] = second, first
        begun = first.begin(MAPPER, ANNA, 600_000, ""), second.begin("/lab/r1", BEN, 600_000, "")
        answers = await asyncio.gather(*begun, return_exceptions=True)
        refused = [answer for answer in answers if isinstance(answer, RefusedError)]
        assert len(refused) == 1 and "is reserved by uid" in str(refused[0]), answers
        for user, answer in zip((ANNA, BEN), answers, strict=True):
            stands = answer is not refused[0]
            assert [each.refusal(60_003, MAPPER).count(f"by uid {user}") for each in (first, second)] == [stands, stands]

    asyncio.run(both())


def test_many_at_once_write_one_file_after_the_other(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async def many() -> None:
        table = at(tmp_path)
        await asyncio.gather(*(table.begin(f"/lab/r{number}", ANNA + number, 600_000, "") for number in range(40)))

    asyncio.run(many())
    assert "do not outlive" not in caplog.text
    assert all(at(tmp_path).refusal(BEN + 99, f"/lab/r{number}") for number in range(40))
