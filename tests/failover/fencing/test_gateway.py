"""The gateway: the highest epoch that was ever seen is never forgotten, and older ones move nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from failover import Gateway, GatewayError, StaleEpochError

GROWING = """
import sys
from failover import Gateway
gateway = Gateway(sys.argv[1])
epoch = gateway.newest
while True:
    epoch += 1
    gateway.admit(epoch)
    print(epoch, flush=True)
"""


def test_an_older_epoch_is_refused_and_the_present_one_is_not(tmp_path: Path) -> None:
    with Gateway(tmp_path / "epoch") as gateway:
        for epoch in (0, 3, 3, 7):
            gateway.admit(epoch)
        with pytest.raises(StaleEpochError, match="epoch 3 is over, 7 has begun") as refused:
            gateway.admit(3)
        assert (refused.value.epoch, refused.value.newest, gateway.newest) == (3, 7, 7)


def test_it_remembers(tmp_path: Path) -> None:
    with Gateway(tmp_path / "epoch") as gateway:
        gateway.admit(2**64 - 1)
    with Gateway(tmp_path / "epoch") as gateway, pytest.raises(StaleEpochError):
        gateway.admit(2**64 - 2)


def test_whenever_it_is_killed_what_it_admitted_is_not_forgotten(tmp_path: Path) -> None:
    newest = 0
    for lines in (1, 2, 5, 9):
        growing = subprocess.Popen([sys.executable, "-c", GROWING, str(tmp_path / "epoch")], stdout=subprocess.PIPE)
        assert growing.stdout is not None
        for _ in range(lines):
            newest = max(newest, int(growing.stdout.readline()))
        os.kill(growing.pid, signal.SIGKILL)
        newest = max([newest, *map(int, growing.stdout.read().split())])
        growing.wait()
        with Gateway(tmp_path / "epoch") as gateway:
            assert gateway.newest in (newest, newest + 1)
            newest = gateway.newest


@pytest.mark.parametrize("content", [b"", b"FOEPOCH1", b"FOEPOCH1" + bytes(12), bytes(20)])
def test_a_damaged_file_lets_nothing_pass(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "epoch").write_bytes(content)
    with pytest.raises(GatewayError, match="is damaged"):
        Gateway(tmp_path / "epoch")


def test_two_gateways_do_not_decide_for_one_actuator(tmp_path: Path) -> None:
    with Gateway(tmp_path / "epoch"):
        with pytest.raises(GatewayError, match="another process has it"):
            Gateway(tmp_path / "epoch")
    Gateway(tmp_path / "epoch").close()


@pytest.mark.parametrize("epoch", [-1, 2**64, True, "3", 3.0, None])
def test_what_is_no_epoch_is_refused(tmp_path: Path, epoch: object) -> None:
    with Gateway(tmp_path / "epoch") as gateway, pytest.raises(GatewayError, match="is no epoch"):
        gateway.admit(epoch)  # type: ignore[arg-type]


def test_an_epoch_that_cannot_be_made_durable_is_not_obeyed(tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    with Gateway(place / "epoch") as gateway:
        gateway.admit(1)
        place.rename(tmp_path / "gone")
        with pytest.raises(GatewayError, match="nothing is obeyed"):
            gateway.admit(2)
        gateway.admit(1)
        assert gateway.newest == 1


def test_an_operator_may_begin_anew(tmp_path: Path) -> None:
    with Gateway(tmp_path / "epoch") as gateway:
        gateway.admit(9)
        gateway.reset()
        gateway.admit(1)
    assert Gateway(tmp_path / "epoch").newest == 1


def test_of_threads_that_ask_at_once_none_passes_behind_a_later_epoch(tmp_path: Path) -> None:
    passed: list[int] = []
    with Gateway(tmp_path / "epoch") as gateway:

        def ask(epoch: int) -> None:
            try:
                with gateway.passing(epoch):
                    passed.append(epoch)
            except StaleEpochError:
                pass

        threads = [threading.Thread(target=ask, args=(epoch,)) for epoch in range(40)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert gateway.newest == 39
        assert passed == sorted(passed)
