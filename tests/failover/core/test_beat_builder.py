"""What a robot's heartbeats say of components that do not fit one of them, and what of a heartbeat that never left."""

from __future__ import annotations

from failover.core.beat_builder import Speaker
from failover.core.election.consent import STATES
from failover.core.types import State
from failover.core.wire.messages import Entry

NAMES = [f"/lab/robot1/component-with-a-long-name-{number:02}" for number in range(30)]


def entry(name: str, sequence: int = 1) -> Entry:
    return Entry(name, STATES.index(State.PRIMARY), 1, "robot1", 1, sequence, b"12345678", "robot2")


def test_with_every_second_heartbeat_replaced_before_its_slot_each_component_is_told() -> None:
    speaker, entries = Speaker("robot1", 1, members=8), {name: entry(name) for name in NAMES}
    told: set[str] = set()
    for turn in range(12):
        beat = speaker.beat(entries, ())
        assert 0 < len(beat.entries) < len(NAMES) * 2 // 3, "they fit two or three heartbeats"
        if turn % 2:
            told.update(one.name for one in beat.entries)
        else:
            speaker.unsaid(beat)
    assert told == set(NAMES)


def test_what_a_later_heartbeat_has_said_stays_said() -> None:
    speaker = Speaker("robot1", 1)
    first = speaker.beat({NAMES[0]: entry(NAMES[0])}, ())
    second = speaker.beat({NAMES[0]: entry(NAMES[0], 2)}, ())
    speaker.unsaid(first)
    assert speaker._said[NAMES[0]] == (second.entries[0], second.counter)
    assert not speaker.pressing({NAMES[0]: entry(NAMES[0], 2)})
