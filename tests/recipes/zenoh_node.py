"""A zenoh program: ``router PORT``, ``talker PORT`` or ``listener PORT``, then true or false: shared memory."""

import sys
import time

import zenoh

what, port, shared = sys.argv[1:4]
config = zenoh.Config()
config.insert_json5("transport/shared_memory/enabled", shared)
config.insert_json5("scouting/multicast/enabled", "false")
if what == "router":
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{port}"]')
else:
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
session = zenoh.open(config)
PADDING = b"." * 100_000  # larger than what goes beside shared memory


def heard(sample: zenoh.Sample) -> None:
    print(bytes(sample.payload).split(b".")[0].decode(), flush=True)


if what == "listener":
    subscriber = session.declare_subscriber("chat", heard)
publisher = session.declare_publisher("chat") if what == "talker" else None
print("ready", flush=True)
count = 0
while True:
    count += 1
    if publisher is not None:
        publisher.put(str(count).encode() + PADDING)
    time.sleep(0.05)
