"""A snapshot whose facts are not what they should be: it is refused in words, and the keeper that was to restore it lives on."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable, Mapping

import pytest
from msgspec.structs import replace

from checkpoint.errors import FormatError, MismatchError
from checkpoint.keeper import messages
from checkpoint.keeper.messages import memfd_holding
from checkpoint.linux.spawn.vessel import Birth, discard, spawn_vessel
from checkpoint.model import Fact, Snapshot
from checkpoint.snapshot import untrusted
from checkpoint.snapshot.format import encode_bytes
from checkpoint.store.chain import position_of
from tests.checkpoint.keeper.test_keeper_death import keeping
from tests.checkpoint.round_trip import captured_and_killed, ended, start

pytestmark = pytest.mark.root

Facts = Mapping[str, Fact]
SPOILT: Mapping[str, Callable[[Facts], Facts]] = {
    "a fact that is missing": lambda facts: {name: value for name, value in facts.items() if name != "flags"},
    "flags that are a text": lambda facts: {**facts, "flags": "many"},
    "an offset without end": lambda facts: {**facts, "offset": 1 << 62, "size": -1},
    "a path with an end in it": lambda facts: {**facts, "path": "/tmp/a\0b"},
    "descriptors that are none": lambda facts: {**facts, "descriptors": [["x", None]]},
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Snapshot:
    directory = tmp_path_factory.mktemp("facts")
    (directory / "read").write_text("something")
    code = "import time; held = open('read'); print('ready', flush=True); time.sleep(1000)"
    with ended(start([sys.executable, "-S", "-c", code], directory)) as program:
        program.wait_for_line("ready")
        return captured_and_killed(program)


@pytest.mark.parametrize("spoil", SPOILT)
def test_a_snapshot_with_hostile_facts_is_refused_and_the_keeper_lives_on(spoil: str, whole: Snapshot) -> None:
    place = next(index for index, held in enumerate(whole.resources) if str(held.facts.get("path")).endswith("/read"))
    held = whole.resources[place]
    resources = list(whole.resources)
    resources[place] = replace(held, facts=dict(SPOILT[spoil](held.facts)))
    spoilt = replace(whole, resources=tuple(resources))
    spoilt = replace(spoilt, position=position_of(spoilt, 1, 1))  # whoever made it up knows how to name it
    null = os.open(os.devnull, os.O_RDWR)
    snapshot = memfd_holding(encode_bytes(spoilt), "snapshot")
    born = spawn_vessel(Birth(inner_pid=whole.process.pid, stdio=(null, null, null)))
    try:
        with keeping() as keeper:
            answer, _ = keeper.ask(messages.Restore(born.pid, "/test/spoilt"), (snapshot,))
            assert isinstance(answer, messages.Failed), answer
            assert "cannot restore" in answer.message, answer
            told, _ = keeper.ask(messages.Compare(), (snapshot,))
            assert isinstance(told, messages.Failed | messages.Compared), told
            assert isinstance(keeper.ask(messages.Probe(os.getpid()), ())[0], messages.Probed | messages.Failed)
    finally:
        discard(born)
        os.close(snapshot)
        os.close(null)


def test_what_is_refused_in_words_already_stays_as_it_is(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(MismatchError, match="not here"), untrusted.facts("restore /lab/a"):
        raise MismatchError("it is not here")
    assert not caplog.records
    with pytest.raises(FormatError, match=r"cannot restore /lab/a: .* \(KeyError: 'flags'\)"), untrusted.facts("restore /lab/a"):
        raise KeyError("flags")
    assert caplog.records[0].exc_info


def test_what_this_machine_lacks_is_not_said_to_be_the_snapshots_fault() -> None:
    with pytest.raises(FormatError, match=r"^cannot restore /lab/a: No space left on device; if this machine lacks"):
        with untrusted.facts("restore /lab/a"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
