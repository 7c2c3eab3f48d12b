"""What a person who sends programs, and a robot that hands one over, may write."""

from __future__ import annotations

import msgspec

from tests.fuzz.target import Decoder, target


@target("anyone who may send a program: a bundle, before its signature counts")
def bundle_file() -> Decoder:
    from failover.core.programs import bundle
    from tests.failover.core.programs.test_bundle import SIGNED, WHOLE

    def call(content: bytes) -> object:
        signature, rest = bundle.split(content)
        return signature, bundle.read(rest)

    return Decoder([WHOLE, bundle.with_signature(WHOLE, SIGNED)], call)


@target("a person whose signature counts: files in a bundle, with headers that fit")
def bundle_members() -> Decoder:
    from failover.core.programs import archive, bundle
    from failover.core.programs.archive import BLOCK, END
    from tests.failover.core.programs.test_bundle import WHOLE

    members = [(one.path.encode(), bytes(one.content)) for one in archive.unpack(WHOLE)]
    seeds = [b"\0\0".join(path + b"\0" + content for path, content in members)]

    def call(changed: bytes) -> object:
        parts = []
        for one in changed.split(b"\0\0"):
            path, _, content = one.partition(b"\0")
            head = archive.header(path.decode(errors="surrogateescape"), len(content))
            parts += [head, content, bytes(-len(content) % BLOCK)]
        return bundle.read(b"".join([*parts, END]))

    return Decoder(seeds, call)


@target("a person whose signature counts: the manifest of a program", "json")
def bundle_manifest() -> Decoder:
    from failover.core.programs import manifest
    from tests.failover.core.programs.test_bundle import SAID

    return Decoder([manifest.encode(SAID)], manifest.decode)


@target("another robot, by a takeover: what a program's host keeps", "json")
def carried_shelf() -> Decoder:
    from failover.core.programs.states import Shelf, Version
    from failover.programs import carried

    shelf = Shelf(name="engine", path="Lab/robot1/PWM", versions=(Version(version="1.2", digest="ab" * 32),))
    return Decoder([msgspec.json.encode(shelf)], lambda content: carried._read(content, Shelf))


@target("another robot, by a takeover: the state of a program that was sent", "msgpack")
def carried_state() -> Decoder:
    from failover.programs import carried
    from failover.programs.channel import State
    from failover.programs.store import Kept

    kept = Kept(3, "1.2", State(b"state", (("array", bytes(8)),)), {}, 1.5)
    return Decoder([msgspec.msgpack.encode(kept)], carried.kept_in)


@target("the process of a program that was sent: what it says to its host", "msgpack")
def program_channel() -> Decoder:
    import socket

    from failover.programs.channel import Channel, Done, Failed, Ready, State

    host, program = socket.socketpair()
    channel = Channel(host)
    seeds = [channel._encode(one) for one in (Done(b"{}", State(b"x")), Failed("no"), Ready(None, ("note",)))]

    def call(content: bytes) -> object:
        program.sendall(len(content).to_bytes(4, "big") + content)
        return channel.receive(5.0)

    return Decoder(seeds, call)
