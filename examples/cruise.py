"""A program for a robot's engine that keeps its state: it drives to and fro, ten times a second, and never loses its place.

python cruise.py                               with the driver of engine.py, or of a real engine
FAILOVER_WORLD=Simulated python cruise.py      with the engine of a simulated robot: failover simulate
"""

from __future__ import annotations

import math
import sys

import failover

ENGINE = "University/Lab/Robotino/Engines/3/PWM"
PERIOD = 50  # steps of one way to and fro

state = failover.resume("cruise", default={"step": 0})
if resumed := failover.resumed():
    print(f"goes on after step {state['step']}, {resumed.age_s:.2f} s old", file=sys.stderr, flush=True)
with failover.proxy(ENGINE) as engine:
    for _ in failover.every(0.1):  # each turn that is done is committed
        state["step"] += 1
        engine.call("set", duty=round(0.5 * math.sin(2 * math.pi * state["step"] / PERIOD), 3), timeout=60)
        told = engine.call("read", timeout=60)
        print(state["step"], told["duty"], told["rpm"], flush=True)
