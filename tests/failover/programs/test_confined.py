"""What a program that was sent can do: nothing that its manifest does not name; and what is not enforced is told."""

from __future__ import annotations

import os
import socket

import pytest

from failover.programs import confine
from failover.programs.channel import Confinement
from tests.failover.programs.senders import Lab, engine

LOOKS = "import socket, pathlib, glob\nreturn eval(what)"


@pytest.mark.root
def test_a_program_under_root_is_a_user_of_its_own_without_network_and_without_others_files(lab: Lab) -> None:
    lab.send("1", engine(extra=LOOKS))
    secret = lab.folder / "secret"
    secret.write_text("x")
    with socket.create_server(("127.0.0.1", 0)) as listening, lab.hosting("1") as host, lab.proxy() as proxy:

        def seen(expression: str) -> object:
            return proxy.call("fly", what=expression, timeout=30)

        port = listening.getsockname()[1]
        shelf = lab.store.shelf("engine")
        assert seen("[*os.getresuid(), *os.getresgid()]") == [shelf.uid] * 6 and shelf.uid != 0
        assert seen("os.getgroups()") == []
        assert seen(f"socket.socket().connect_ex(('127.0.0.1', {port}))") != 0
        assert seen("sorted(name for _, name in socket.if_nameindex())") in (["lo"], [])
        assert seen(f"pathlib.Path({str(secret)!r}).exists()") is False
        assert seen("[os.listdir(one) for one in ('/home', '/var', '/srv')]") == [[], [], []]
        assert seen("os.access('/etc', os.W_OK)") is False and seen("os.access('.', os.W_OK)") is True
        assert seen("pathlib.Path('mine').write_text('x')") == 1
        assert set(seen("os.listdir('/dev')")) == {"null", "zero", "full", "random", "urandom", "shm"}  # type: ignore[call-overload]
        assert seen("len(glob.glob('/proc/[0-9]*'))") == 1, "itself"
        status = str(seen("open('/proc/self/status').read()"))
        assert "CapEff:\t0000000000000000" in status and "NoNewPrivs:\t1" in status
        told = " ".join(host.confinement_told())
        assert "no network" in told and f"uid {shelf.uid} of its own" in told and "processor has no limit" in told


@pytest.mark.root
def test_the_network_is_there_if_the_manifest_names_it(lab: Lab) -> None:
    lab.send("1", engine(extra=LOOKS), network=True)
    with socket.create_server(("127.0.0.1", 0)) as listening, lab.hosting("1"), lab.proxy() as proxy:
        port = listening.getsockname()[1]
        assert proxy.call("fly", what=f"socket.socket().connect_ex(('127.0.0.1', {port}))", timeout=30) == 0


def test_a_version_dies_with_its_host_and_leaves_no_process(lab: Lab) -> None:
    lab.send("1", engine(extra="return os.getpid()"))
    with lab.hosting("1") as host, lab.proxy() as proxy:
        assert proxy.call("fly", timeout=30)
        pid = host.actor._running.pid  # type: ignore[union-attr]
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_from_a_directory_nothing_is_taken_and_that_is_told() -> None:
    found = confine.confine(Confinement(is_trusted=True), "/somewhere")
    assert found.enforced == [] and "all that this user may do" in found.not_enforced[0] and found.directory == "/somewhere"


@pytest.mark.root
def test_no_code_comes_from_where_the_host_was_started_and_folders_bound_below_tmp_stay_read_only(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere, modules = lab.folder / "elsewhere", lab.folder / "modules"
    for folder in (elsewhere, modules):
        folder.mkdir()
    (elsewhere / "failover").mkdir()
    (elsewhere / "failover" / "__init__.py").write_text("raise SystemExit('foreign code')")
    modules.chmod(0o777)
    monkeypatch.chdir(elsewhere)
    monkeypatch.setenv("PYTHONPATH", str(modules))
    lab.send("1", engine(extra=LOOKS))
    with lab.hosting("1"), lab.proxy() as proxy:

        def seen(expression: str) -> object:
            return proxy.call("fly", what=expression, timeout=30)

        assert str(lab.folder).startswith("/tmp/")
        assert seen(f"os.path.exists({str(elsewhere)!r})") is False
        assert seen(f"[os.path.isdir({str(modules)!r}), os.access({str(modules)!r}, os.W_OK)]") == [True, False]
        assert seen("os.path.exists('/etc/failover') and os.listdir('/etc/failover')") in (False, [])
