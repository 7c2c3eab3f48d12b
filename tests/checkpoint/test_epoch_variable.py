"""Where the fencing token stands in an environment."""

from __future__ import annotations

import pytest

from checkpoint import epoch_variable


def test_the_digits_of_any_epoch_are_found_where_they_can_be_written_over() -> None:
    environment = b"PATH=/bin\0" + epoch_variable.assignment(7) + b"\0HOME=/root\0"
    place = epoch_variable.place_in(environment)
    assert place is not None
    renewed = environment[:place] + epoch_variable.digits(2**64 - 1) + environment[place + epoch_variable.DIGITS :]
    assert len(renewed) == len(environment)
    assert (epoch_variable.epoch_in(environment), epoch_variable.epoch_in(renewed)) == (7, 2**64 - 1)


@pytest.mark.parametrize(
    "environment",
    [b"", b"\0\0", b"FAILOVER_EPOCH=7\0", b"XFAILOVER_EPOCH=00000000000000000007\0", b"FAILOVER_EPOCH=0000000000000000000x\0"],
)
def test_what_is_no_token_of_ours_is_left_alone(environment: bytes) -> None:
    assert epoch_variable.place_in(environment) is None
    assert epoch_variable.epoch_in(environment) == 0
