"""A Cyclone DDS program: ``talker`` publishes numbers, ``listener`` prints what it hears."""

import sys
import time
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
class Number(IdlStruct, typename="Number"):  # type: ignore[call-arg]
    value: int


participant = DomainParticipant(int(sys.argv[2]))
topic = Topic(participant, "chat", Number, qos=Qos(Policy.Reliability.Reliable(duration(seconds=1))))
if sys.argv[1] == "listener":
    reader = DataReader(participant, topic)
    print("ready", flush=True)
    while True:
        for sample in reader.take(100):
            if isinstance(sample, Number):
                print(sample.value, flush=True)
        time.sleep(0.01)
writer = DataWriter(participant, topic)
print("ready", flush=True)
count = 0
while True:
    count += 1
    writer.write(Number(count))
    time.sleep(0.05)
