"""Commands at the pace of their device, and those in a row as one."""

from __future__ import annotations

import itertools

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from failover.core.messaging.envelope import Envelope
from failover.core.messaging.pacing import SECOND, Pace, merged


@settings(suppress_health_check=list(HealthCheck))
@given(rate_hz=st.floats(0.1, 1_000), gaps_ns=st.lists(st.integers(0, 2 * SECOND), max_size=50))
def test_no_command_begins_within_a_period_of_the_one_before(rate_hz: float, gaps_ns: list[int]) -> None:
    pace, now_ns = Pace(rate_hz), 0
    begun: list[int] = []
    for gap_ns in gaps_ns:
        now_ns += gap_ns
        now_ns += pace.wait_ns(now_ns)
        assert not pace.wait_ns(now_ns)
        pace.begun(now_ns)
        begun.append(now_ns)
    assert all(later - earlier >= round(SECOND / rate_hz) for earlier, later in itertools.pairwise(begun))


def test_without_a_rate_nothing_waits() -> None:
    pace = Pace(None)
    pace.begun(5)
    assert pace.wait_ns(5) == 0


def test_later_fields_win_and_earlier_ones_are_not_lost() -> None:
    run = [Envelope(verb="set", body=body, id=name) for name, body in (("a", {"x": 1, "y": 1}), ("b", {"x": 2}), ("c", {"z": 3}))]
    one = merged(run)
    assert (one.id, one.body) == ("c", {"x": 2, "y": 1, "z": 3})


def test_a_body_that_is_no_table_replaces_all_before() -> None:
    assert merged([Envelope(body={"x": 1}), Envelope(body=4)]).body == 4
    assert merged([Envelope(body=4), Envelope(body={"x": 1})]).body == {"x": 1}
