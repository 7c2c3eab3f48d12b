"""The program that is measured: a shell loop with constant children; prints "ready"."""

import os

os.execvp("sh", ["sh", "-c", "echo ready; while :; do /bin/true; done"])
