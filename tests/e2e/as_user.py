"""A command line of failover, given by an ordinary user: ``python as_user.py USER failover …``.

All of it is loaded before this process becomes that user, who need not find the way to this Python.
"""

import importlib
import os
import pkgutil
import pwd
import sys

import failover.cli
from failover.cli import main

for module in pkgutil.walk_packages(failover.cli.__path__, "failover.cli."):
    if ".demo" not in module.name:
        importlib.import_module(module.name)
user = pwd.getpwnam(sys.argv[1])
os.initgroups(user.pw_name, user.pw_gid)
os.setgid(user.pw_gid)
os.setuid(user.pw_uid)
sys.exit(main.main(sys.argv[3:]))
