"""A keeper's errors arrive as what they are: its peer knows only the classes of ``checkpoint.errors``."""

from __future__ import annotations

import pytest

from checkpoint.engines.ptrace.capture.tree import MovedError
from checkpoint.engines.ptrace.restore.threads import IdInUseError
from checkpoint.errors import CaptureError, CheckpointError, RestoreError, UnsupportedError
from checkpoint.keeper import messages
from failover.cli import keeper_client


@pytest.mark.parametrize(
    ("error", "known"),
    [
        (MovedError("it moved"), CaptureError),
        (IdInUseError("it is taken"), RestoreError),
        (UnsupportedError("it has a GPU", ("it has a GPU",)), UnsupportedError),
        (messages.ChannelError("no message"), CheckpointError),
    ],
)
def test_an_error_is_told_as_the_nearest_class_that_its_peer_knows(error: CheckpointError, known: type[CheckpointError]) -> None:
    told = keeper_client.as_error(messages.failed(error))
    assert type(told) is known
    assert str(told) == str(error)
    assert getattr(told, "reasons", ()) == getattr(error, "reasons", ())
