"""A hook that is a signal: what names none is refused, whatever else Python knows by that name."""

from __future__ import annotations

import signal

import pytest

from agent.hooks import signal_in


def test_a_signal_is_found_by_its_name() -> None:
    assert signal_in(("signal:SIGUSR2",)) == signal.SIGUSR2
    assert signal_in(("/bin/signal:SIGUSR2",)) == 0


@pytest.mark.parametrize("name", ["", "mro", "name", "__class__", "SIGKILL", "SIGSTOP", "SIGNONE", "12"])
def test_what_names_none_that_a_program_can_handle_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="names no signal"):
        signal_in((f"signal:{name}",))
